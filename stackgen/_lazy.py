"""Packages that import a public name when it is first asked for, so that importing the package costs nothing."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make the `__getattr__` and the `__dir__` of a package.

    Args:
        package: Name of the package.
        homes: The module of each public name, relative to the package.

    >>> attribute, names = lazy("stackgen", {"Stack": "stack"})
    >>> attribute("Stack").__name__, "Stack" in names()
    ('Stack', True)
    """

    def attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)

    return attribute, lambda: sorted({*vars(sys.modules[package]), *homes})
