"""stackgen: stable block structures from silhouettes.

>>> import stackgen
>>> stackgen.best("examples/silhouettes/arch.png").stacks  # doctest: +SKIP
>>> model = stackgen.load()  # doctest: +SKIP
>>> stacks = model.sample("examples/silhouettes/arch.png", num_samples=3, seed=0)  # doctest: +SKIP
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from stackgen.api import Model, best, load, sample
    from stackgen.errors import StackgenError
    from stackgen.stack import Stack

__all__ = ["Model", "Stack", "StackgenError", "best", "load", "sample"]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__, submod_attrs={"api": ["Model", "best", "load", "sample"], "errors": ["StackgenError"], "stack": ["Stack"]}
)
