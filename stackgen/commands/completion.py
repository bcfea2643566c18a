"""stackgen completion: print a script by which a shell completes verbs, options and their choices."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from typing import Literal

from jsonargparse import ArgumentParser

from stackgen.commands.cli import VERBS, usage
from stackgen.commands.parsing import Command

Shell = Literal["bash", "zsh", "fish"]


def main(shell: Shell = "bash") -> None:
    """Print a script that completes stackgen's command line. The shell completes by it alone, without starting Python.

    Args:
        shell: Shell that the script is for.
    """
    sys.stdout.write(whole_parser().get_completion_script(f"shtab-{shell}") + "\n")


def whole_parser() -> ArgumentParser:
    """Make one parser of the whole command line."""
    root = ArgumentParser(prog="stackgen", description=usage().splitlines()[2])
    verbs = root.add_subcommands(required=False)
    for name, verb in VERBS.items():
        found = parsers_of(name)
        if isinstance(found, Mapping):
            verbs.add_subcommand(name, parent := ArgumentParser(), help=verb.help)
            parts = parent.add_subcommands(required=False)
            for part, parser in found.items():
                parts.add_subcommand(part, _with_files(parser))
        else:
            verbs.add_subcommand(name, _with_files(found), help=verb.help)
    return root


def parsers_of(verb: str) -> ArgumentParser | dict[str, ArgumentParser]:
    """Make the parser of a verb; for a verb that has parts, their parsers by name."""
    module = importlib.import_module(VERBS[verb].module)
    if hasattr(module, "COMMAND"):
        return module.COMMAND.parser()
    if hasattr(module, "COMMANDS"):
        return {name: command.parser() for name, command in module.COMMANDS.items()}
    return module.parser_of(verb)


def _with_files(parser: ArgumentParser) -> ArgumentParser:
    """Let texts be completed as files: weights are given by a name or by a path."""
    import shtab

    for action in parser._actions:
        kind = getattr(action, "_typehint", None)
        if kind in (str, str | None):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    return parser


COMMAND = Command(
    "completion",
    main,
    """
    stackgen completion > ~/.local/share/bash-completion/completions/stackgen
    stackgen completion --shell zsh > ~/.zfunc/_stackgen
    """,
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
