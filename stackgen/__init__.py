"""stackgen: stable block structures from silhouettes.

>>> import stackgen
>>> stackgen.best("examples/silhouettes/arch.png").stacks  # doctest: +SKIP
>>> model = stackgen.load()  # doctest: +SKIP
>>> stacks = model.sample("examples/silhouettes/arch.png", num_samples=3, seed=0)  # doctest: +SKIP
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import lazy_loader

if TYPE_CHECKING:
    from stackgen.api import Model, best, load, sample
    from stackgen.errors import StackgenError
    from stackgen.stack import Stack

__all__ = ["Model", "Stack", "StackgenError", "best", "load", "sample"]

_attribute, _, _ = lazy_loader.attach(
    __name__, submod_attrs={"api": ["Model", "best", "load", "sample"], "errors": ["StackgenError"], "stack": ["Stack"]}
)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("stackgen")
    return _attribute(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
