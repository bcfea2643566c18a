"""stackgen: stable block structures from silhouettes.

>>> import stackgen
>>> model = stackgen.load()  # doctest: +SKIP
>>> stacks = model.sample("examples/silhouettes/arch.png", num_samples=3, seed=0)  # doctest: +SKIP
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stackgen.api import Model, load, sample
    from stackgen.errors import StackgenError
    from stackgen.stack import Stack

__all__ = ["Model", "Stack", "StackgenError", "load", "sample"]

_HOME = {"Stack": "stackgen.stack", "StackgenError": "stackgen.stack"}


def __getattr__(name: str) -> Any:
    """Import a name when it is first asked for, so that `import stackgen` costs nothing."""
    if name not in __all__:
        raise AttributeError(f"module 'stackgen' has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(_HOME.get(name, "stackgen.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
