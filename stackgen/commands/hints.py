"""`did you mean`: the option, key or class that is nearest to what a user wrote."""

from __future__ import annotations

import difflib
import importlib
import re
import sys

from jsonargparse import ArgumentParser

_CLASS = re.compile(r"Problem with given class_path '([\w.]+)'")
_OPTION = re.compile(
    r"unrecognized arguments: (?P<flag>--[^\s=]+)"
    r"|(Group '(?P<group>[\w.]+)' does not accept option|does not accept option|Option) '(?P<key>[\w.]+)'"
)
_NAME = re.compile(
    r"(?:module '|No )(?P<module>[\w.]+)(?:' has no attribute '| attribute )(?P<name>\w+)"
)  # lazy-loader's


def did_you_mean(parser: ArgumentParser, message: str) -> str:
    """Name the option, key or class that is nearest to one that does not exist, in words that follow the message.

    Args:
        parser: Parser of the verb.
        message: Message of jsonargparse about the command line.

    Returns:
        The words, or nothing if none is near or the message is about something else.

    >>> parser = ArgumentParser()
    >>> _ = parser.add_argument("--num_samples")
    >>> did_you_mean(parser, "unrecognized arguments: --num_sample 3")
    ' (did you mean --num_samples?)'
    >>> did_you_mean(parser, "Option 'num_sampels' is not accepted")
    ' (did you mean num_samples?)'
    """
    if name := _NAME.search(message):
        return _nearest(name["name"], dir(sys.modules.get(name["module"])))
    option = _OPTION.search(message)
    if option is None:
        return ""
    classes = _CLASS.findall(message[: option.start()])
    known = options_of(_parser_of(classes[-1]) if classes else parser)
    if option["flag"]:
        return _nearest(option["flag"], known)
    key = ".".join(filter(None, (option["group"], option["key"])))
    return _nearest(key, [name.removeprefix("--") for name in known])


def options_of(parser: ArgumentParser) -> list[str]:
    """List all options of a parser, with their dashes."""
    return [option for action in parser._actions for option in action.option_strings]


def _parser_of(class_path: str) -> ArgumentParser:
    """Make a parser of the options of a class; it can be imported, for the message comes from its own parser."""
    module, _, name = class_path.rpartition(".")
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(getattr(importlib.import_module(module), name), sub_configs=True, fail_untyped=False)
    return parser


def _nearest(wrong: str, known: list[str]) -> str:
    near = difflib.get_close_matches(wrong, known, n=1, cutoff=0.7)
    return f" (did you mean {near[0]}?)" if near else ""
