"""stackgen completion: a script by which a shell completes verbs, options and their choices."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args, get_origin

from stackgen.commands.cli import VERBS, usage
from stackgen.commands.parsing import Command

Shell = Literal["bash", "zsh", "fish"]


def main(shell: Shell = "bash") -> None:
    """Print a script that completes stackgen's command line; the shell runs it at its start, no Python is started then.

    Args:
        shell: Whose language it is written in.
    """
    import shtab

    sys.stdout.write(shtab.complete(skeleton(), shell) + "\n")


def skeleton() -> argparse.ArgumentParser:
    """The whole command line as a plain parser: verbs, option names and choices, without types and defaults."""
    root = argparse.ArgumentParser("stackgen", description=usage().splitlines()[2])
    verbs = root.add_subparsers(dest="verb")
    for name, verb in VERBS.items():
        found = parsers_of(name)
        plain = verbs.add_parser(name, help=verb.help, add_help=False)
        if isinstance(found, Mapping):
            parts = plain.add_subparsers(dest="part")
            for part, parser in found.items():
                _copy_options(parser, parts.add_parser(part, add_help=False))
        else:
            _copy_options(found, plain)
    return root


def parsers_of(verb: str) -> argparse.ArgumentParser | dict[str, argparse.ArgumentParser]:
    """The parser of a verb; of a verb that has parts, theirs by name."""
    module = importlib.import_module(VERBS[verb].module)
    if hasattr(module, "COMMAND"):
        return module.COMMAND.parser()
    if hasattr(module, "COMMANDS"):
        return {name: command.parser() for name, command in module.COMMANDS.items()}
    return module.parser_of(verb)


def _copy_options(source: argparse.ArgumentParser, plain: argparse.ArgumentParser) -> None:
    """Give a plain parser the options of one of ours."""
    import shtab

    for action in source._actions:
        kind = getattr(action, "_typehint", action.type)
        help_text = (str(action.help) if action.help not in (None, argparse.SUPPRESS) else "").replace("%", "%%")
        options: dict[str, Any] = {"help": help_text.partition(". ")[0]}
        if action.nargs == 0:
            options["action"] = "store_true"
        elif choices := choices_of(kind):
            options["choices"] = choices
        if action.option_strings:
            options["dest"] = action.option_strings[-1].lstrip("-")
            copy = plain.add_argument(*action.option_strings, **options)
        else:
            copy = plain.add_argument(action.dest, **({"nargs": "*"} | options))
        if action.nargs != 0 and "choices" not in options:
            copy.complete = shtab.FILE  # type: ignore[attr-defined]


def choices_of(kind: Any) -> list[str]:
    """The values that a type has, if they can be listed.

    >>> choices_of(Literal["a", "b"] | None), choices_of(bool), choices_of(int | str)
    (['a', 'b'], ['true', 'false'], [])
    """
    if kind is bool:
        return ["true", "false"]
    if get_origin(kind) is Literal:
        return [str(value) for value in get_args(kind)]
    return [choice for part in get_args(kind) if get_origin(kind) is not dict for choice in choices_of(part)]


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
