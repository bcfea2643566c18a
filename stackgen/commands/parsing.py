"""The verbs of the command line, and how their typed functions become parsers."""

from __future__ import annotations

import argparse
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml
from jsonargparse import (
    ArgumentError,
    ArgumentParser,
    DefaultHelpFormatter,
    Namespace,
    get_loader,
    set_dumper,
    set_loader,
    set_parsing_settings,
)
from jsonargparse.typing import register_type

from stackgen.commands.cli import explain
from stackgen.commands.hints import did_you_mean
from stackgen.commands.old_names import renew
from stackgen.commands.output import FORMS, chosen, telling
from stackgen.errors import MALFORMED, StackgenError
from stackgen.io.files import is_endless
from stackgen.io.text import parse_yaml, read_text, texts_in, to_yaml

if TYPE_CHECKING:
    from stackgen.world import Catalogue

Mode = Literal["yaml", "omegaconf+"]
"""How configuration files are read: with `omegaconf+`, `${...}` stands for another option's value."""


def _catalogue(value: Any) -> Catalogue:
    """Make a catalogue from what stands in YAML, or from what jsonargparse makes of a default."""
    from stackgen.world import Catalogue

    if isinstance(value, Mapping) and "init_args" in value:
        return Catalogue(value["init_args"]["shapes"])
    return Catalogue.from_config(value)


@cache
def _read_files_as(mode: Mode) -> Mode:
    """Teach jsonargparse to read configuration files; OmegaConf is imported only where it is asked for."""
    # What is saved is read back as it was, and no text of a user's is a bug.
    set_dumper("yaml", to_yaml)
    loader = get_loader("yaml")
    if mode == "omegaconf+":
        from jsonargparse._optionals import get_omegaconf_loader

        loader = get_omegaconf_loader(mode)
    set_loader(mode, _of_finite_size(loader), (yaml.YAMLError, ValueError, RecursionError))
    return mode


def _of_finite_size(loader: Callable[[str], Any]) -> Callable[[str], Any]:
    """Refuse text whose aliases stand for more than anybody would write, before another reader writes them out."""

    def load(text: str) -> Any:
        if "&" in text:
            try:
                parse_yaml(text, "it")
            except StackgenError as error:
                raise ValueError(str(error)) from error
        return loader(text)

    return load


@cache
def _know_catalogues() -> None:
    """Teach jsonargparse catalogues: in YAML a list of shapes, and no group of options."""
    from stackgen.world import Catalogue

    register_type(Catalogue, Catalogue.to_json, _catalogue)
    set_parsing_settings(subclasses_enabled=[Catalogue])


def parser_options(mode: Mode) -> dict[str, Any]:
    """Give what all our parsers have in common; they raise their errors instead of printing them."""
    if "stackgen.world" in sys.modules:  # else nobody can have an option that is a catalogue
        _know_catalogues()
    common = {"formatter_class": HelpFormatter, "exit_on_error": False, "allow_abbrev": False}
    return {**common, "parser_mode": _read_files_as(mode)}


CONFIG_FLAGS = ("-c", "--config")
HELP_OF_ALL = "--help=all"
CONFIG_HELP = "YAML file with these options, or with a section named like the verb that holds them."


_LITERAL = re.compile(r"(Optional\[)?Literal\[(.*?)\](?(1)\])")


class HelpFormatter(DefaultHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Leaves the line breaks of the example under a help alone; names shapes and types as a person would."""

    def _get_help_string(self, action: argparse.Action) -> str:
        if isinstance(action.default, Mapping) and "shapes" in action.default.get("init_args", ()):
            return f"{action.help} (default: {', '.join(_catalogue(action.default).names)})"
        return super()._get_help_string(action)

    def _expand_help(self, action: argparse.Action) -> str:
        text = re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", super()._expand_help(action))
        return _LITERAL.sub(
            lambda found: found[2].replace("'", "").replace(", ", " | ") + (" | null" if found[1] else ""), text
        )


@dataclass(frozen=True)
class Files:
    """The argument that a verb takes without its name.

    Args:
        parameter: Parameter of the verb's function.
        metavar: Name of the argument in the help.
        help: Description of the argument.
        many: Whether it takes any number of paths, at least one, instead of exactly one.
        optional: Whether it may be left out.
    """

    parameter: str
    metavar: str
    help: str
    many: bool = False
    optional: bool = False


@dataclass(frozen=True)
class Command:
    """A typed function as a verb: its parameters are the options, its docstring their help.

    Args:
        verb: Name of the verb.
        function: Function that is called; it returns the exit code, or None for 0.
        example: Command lines that are shown under the help.
        files: Paths that the verb takes, if any.
        settings: Parameters that are dataclasses, with their types; their fields are options of their own, without a
            prefix.
        flags: Boolean parameters that are switched on by naming them, with their help.
        hidden: Options whose parts (`cell` for `--cell.*`) only `--help=all` shows.
        reports: Whether it tells what it found through `commands.output`: it then has --json and --quiet.
        interpolation: Whether `${...}` in configuration files stands for another option's value.
        config: Parameter that takes the text of all options as YAML, to be kept with what the verb makes.
    """

    verb: str
    function: Callable[..., int | None]
    example: str
    files: Files | None = None
    settings: Mapping[str, type] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()
    reports: bool = False
    interpolation: bool = True
    config: str | None = None

    def parser(self, mode: Mode | None = None) -> ArgumentParser:
        """Make the parser; files are read as the verb has it, unless another mode is given."""
        parser = ArgumentParser(
            **parser_options(mode or ("omegaconf+" if self.interpolation else "yaml")),
            prog=f"stackgen {self.verb}",
            description=(self.function.__doc__ or "").partition("\n\n")[0].strip(),
            epilog=epilog(self.example),
        )
        parser.add_argument(*CONFIG_FLAGS, action="config", help=CONFIG_HELP)
        if self.files:
            nargs = "+" if self.files.many else "?" if self.files.optional else None
            # A default of its own would take the place of what a configuration file says.
            no_default: dict[str, Any] = {"default": argparse.SUPPRESS} if self.files.optional else {}
            parser.add_argument(
                self.files.parameter,
                nargs=nargs,
                type=Path,
                metavar=self.files.metavar,
                help=self.files.help,
                **no_default,
            )
        for kind in self.settings.values():
            parser.add_class_arguments(kind, skip=set(self.flags), sub_configs=True, as_group=False)
        for name, text in self.flags.items():
            parser.add_argument(f"--{name}", action="store_true", help=text)
        for name, text in FORMS.items() if self.reports else ():
            parser.add_argument(f"--{name}", action="store_true", help=text)
        special: set[str | int] = {*self.flags, *self.settings, *((self.config,) if self.config else ())}
        if self.files:
            special.add(self.files.parameter)
        parser.add_function_arguments(
            self.function, skip=special, as_group=False, as_positional=False, sub_configs=True
        )
        _without_underscores(parser)
        return parser

    def run(self, argv: Sequence[str]) -> int | None:
        """Parse what follows the verb and call the function."""
        if HELP_OF_ALL in argv:
            self.parser().print_help()
            return 0
        asks_help = {"-h", "--help"} & set(argv)
        parser = self.parser("yaml" if asks_help or not _may_interpolate(argv) else None)
        if asks_help:
            self._shorten_help(parser)
        values = parse(parser, self.verb, own_sections(self.verb, argv))
        values.pop("config", None)
        form = chosen(values.pop("json", False), values.pop("quiet", False))
        text = parser.dump(values, skip_unset=False) if self.config else ""
        with blaming_values():
            options = vars(parser.instantiate(values))
            for name, kind in self.settings.items():
                options[name] = kind(**{item.name: options.pop(item.name) for item in fields(kind)})
        if self.config:
            options[self.config] = text
        with telling(form):
            return self.function(**options)

    def _shorten_help(self, parser: ArgumentParser) -> None:
        """Leave the hidden options out of a parser's help, and say where they are."""
        shown = [action for action in parser._actions if action.help != argparse.SUPPRESS]
        hidden = [action for action in shown if action.dest.partition(".")[0] in self.hidden]
        for action in hidden:
            action.help = argparse.SUPPRESS
        for group in parser._action_groups:
            if all(action.help == argparse.SUPPRESS for action in group._group_actions):
                group.title = group.description = None
        if hidden:
            grouped = {action.dest.partition(".")[0] for action in hidden if "." in action.dest}
            names = ", ".join(f"--{name}.*" if name in grouped else f"--{name}" for name in self.hidden)
            more = f"`{parser.prog} {HELP_OF_ALL}` shows {len(hidden)} more options: {names}"
            parser.epilog = f"{parser.epilog}\n\n{more}"


def _without_underscores(parser: ArgumentParser) -> None:
    """Spell the option of a parameter that is a word of Python's, such as `as_`, without its underscore."""
    for action in parser._actions:
        if action.dest.endswith("_"):
            action.option_strings = [f"--{action.dest.rstrip('_')}"]
            action.metavar = action.dest.rstrip("_").upper()
            parser._option_string_actions[action.option_strings[0]] = action


def epilog(example: str) -> str:
    """Lay out command lines as they stand under a help."""
    return "\n".join(["example:", *(f"  {line.strip()}" for line in example.strip().splitlines())])


def parse(parser: ArgumentParser, verb: str, argv: Sequence[str], own: ArgumentParser | None = None) -> Namespace:
    """Parse, or say in one line what was wrong and where to look.

    Args:
        parser: Parser of the arguments.
        verb: Verb that the arguments belong to.
        argv: Arguments of the command line.
        own: Parser that knows the verb's options, if the other one only knows verbs.

    Raises:
        StackgenError: On an unknown option or key, a missing or ill-typed value, a broken YAML file.
    """
    told = io.StringIO()
    try:
        with redirect_stderr(told):
            return parser.parse_args(list(argv))
    except SystemExit as stop:  # after a help; the parser of a class, which `--x.help` asks, prints its usage and exits
        if not stop.code:
            raise
        line = told.getvalue().partition("error: ")[2]
        told.truncate(0)
        raise StackgenError(f"{shorten(line)}; see `stackgen {verb} --help`") from None
    except _refusals() as error:
        text = str(error).replace(f"required: {verb}.", "required: ")
        raise StackgenError(
            f"{shorten(text)}{did_you_mean(own or parser, text)}; see `stackgen {verb} --help`"
        ) from error
    finally:
        sys.stderr.write(told.getvalue())


def _refusals() -> tuple[type[Exception], ...]:
    """Give the errors by which parsing refuses what was typed; asked for when there is one."""
    from omegaconf.errors import OmegaConfBaseException

    return ArgumentError, OmegaConfBaseException


@contextmanager
def blaming_values() -> Iterator[None]:
    """Say in one line that constructors cannot do with the values that they were given.

    Raises:
        StackgenError: If they cannot.
    """
    try:
        yield
    except MALFORMED as error:
        if explain(error) is not None:  # a line of its own
            raise
        raise StackgenError(f"the configuration cannot be used: {shorten(str(error))}") from error


def _may_interpolate(argv: Sequence[str]) -> bool:
    """Tell whether `${...}` may stand in options or in a file of options: importing OmegaConf takes a while."""
    for before, argument in zip(["", *argv], argv, strict=False):
        value = argument.partition("=")[2] if argument.startswith("-") else argument if before.startswith("-") else ""
        if "${" in argument or argument.startswith(CONFIG_FLAGS) or os.path.isfile(value):
            return True
    return False


def own_sections(verb: str, argv: Sequence[str]) -> list[str]:
    """Replace each `--config FILE` that has a section named like the verb by the text of that section.

    So one file can hold the options of several verbs that belong together. Names that classes had before are
    replaced by those they have now. Files come first: what was typed counts, wherever it stands.

    Raises:
        StackgenError: If a file is no YAML in UTF-8, or holds no options, or any argument is a pipe.
    """
    for value in [part for argument in argv for part in (argument, argument.partition("=")[2])]:
        if is_endless(value):
            raise StackgenError(f"{value} is a pipe, a socket or a device; give a file")
    arguments = [renew(argument) for argument in argv]
    files: list[int] = []
    for index, value in option_values(arguments, CONFIG_FLAGS):
        flag, equals, _ = arguments[index].partition("=")
        joined = bool(equals) and flag in CONFIG_FLAGS
        text = _own_text(value, verb)
        if text is not None:
            arguments[index] = f"{flag}={text}" if joined else text
        files += [index] if joined else [index - 1, index]
    typed = [argument for index, argument in enumerate(arguments) if index not in files]
    return [*(arguments[index] for index in files), *typed]


def option_values(arguments: Sequence[str], flags: Sequence[str]) -> list[tuple[int, str]]:
    """Find the values given to an option, with their places in the arguments.

    >>> option_values(["a", "-c", "x.yaml", "--config=y.yaml"], ("-c", "--config"))
    [(2, 'x.yaml'), (3, 'y.yaml')]
    """
    found = []
    for index, argument in enumerate(arguments):
        flag, equals, value = argument.partition("=")
        if equals and flag in flags:
            found.append((index, value))
        elif index and arguments[index - 1] in flags:
            found.append((index, argument))
    return found


def _own_text(value: str, verb: str) -> str | None:
    """Give the text that is to stand in the place of a configuration file; None for the file as it is."""
    try:
        if not Path(value).is_file():
            return None
    except OSError:  # text instead of a file may be too long for a path
        return None
    text = renew(written := read_text(value))
    content = parse_yaml(text, value)
    if not isinstance(content, dict):
        raise StackgenError(f"--config {value}: it holds no options, which are written as `name: value`")
    for name in texts_in(content):  # which others may take for a file and wait for
        if is_endless(name) or is_endless(str(Path(value).parent / name)):
            raise StackgenError(f"--config {value}: {name} is a pipe, a socket or a device; give a file")
    section = content.get(verb)
    options = section if isinstance(section, dict) else content
    if options.get("config") is not None:
        raise StackgenError(f"--config {value}: a file cannot name another one under `config`; give --config twice")
    if options is section:
        return to_yaml(section)
    return text if text != written or not text.isascii() else None  # others read files in the encoding of the machine


_NOISE = re.compile(
    r"(- )?(Does not validate against any of the Union|Subtypes:|Errors:|Given value|Expected a <class 'NoneType'>"
    r"|Expected a path but|Subclass types expect|a class path|a dict with)"
)


def shorten(message: str, limit: int = 300) -> str:
    """Shorten jsonargparse's paragraphs to one line.

    >>> shorten("Parser key 'data.mode':\\n  Errors:\\n  - Expected a float. Got value: q\\n  - Expected a path but q")
    'data.mode: Expected a float. Got value: q'
    """
    lines = [line.strip() for line in message.splitlines() if line.strip() and not _NOISE.match(line.strip())]
    text = " ".join(dict.fromkeys(line.removeprefix("- ") for line in lines))  # each member of a union says it
    text = re.sub(r"""^Parser key ["'](.*?)_?["']""", r"\1", re.sub(r"<class '([\w.]+)'>", r"\1", text))
    text = re.sub(r"a typing\.Literal\[(.*?)\]", r"one of \1", text)
    return text if len(text) <= limit else f"{text[:limit].rstrip()} ..."
