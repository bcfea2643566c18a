"""The one exception that a user can mend, and the one way to warn."""

from __future__ import annotations

import importlib
import warnings
from types import ModuleType


class StackgenError(Exception):
    """Something a user can mend: the message names what was wrong and what would be right.

    The command line prints it as one line and exits with 2.
    """


MALFORMED = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""What plain data of another form than was expected raises where it is taken apart."""


class Terminated(KeyboardInterrupt):
    """The system asked this process to end (SIGTERM); whatever answers Ctrl-C answers it, too."""


def printable(text: object) -> str:
    """Write text so that it stays in its line and moves no cursor: what is not printable is shown as its escape.

    >>> printable("a house\\n\\x1b[2J")
    'a house\\\\n\\\\x1b[2J'
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in str(text))


def warn(line: str) -> None:
    """One line on stderr, each time; Python's own form of a warning has two, and shows the same one once."""
    warnings.warn_explicit(printable(line), UserWarning, "stackgen", 0)


def require(module: str, extra: str) -> ModuleType:
    """Import an optional package.

    Args:
        module: Name to import.
        extra: The extra of stackgen that installs it.

    Raises:
        StackgenError: If the package is not installed; the line names the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not module.startswith(error.name):
            raise
        raise StackgenError(f"this needs the package {error.name!r}: pip install 'stackgen[{extra}]'") from error
