"""The progress bar of long jobs, shown on stderr where that is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from stackgen.commands.output import is_quiet
from stackgen.io.terminal import Screen


class Advance(Protocol):
    """A function that is given how much is done, and the total if that was not known before."""

    def __call__(self, done: int, total: int | None = None) -> None:
        """Move the bar."""
        ...


def after(before: int, advance: Advance) -> Callable[[int, int], None]:
    """Make a function that moves the bar of several jobs by what one of them has done, after those `before` it."""
    return lambda done, _: advance(before + done)


@contextmanager
def progress_bar(what: str, total: int | None = None) -> Iterator[tuple[Advance, Callable[[str], None]]]:
    """Show a bar until the block ends.

    Args:
        what: Name of what is counted.
        total: Number of all of them; None as long as it is not known.

    Yields:
        A function that moves the bar, and one that prints a line above it; the line also comes out where there
        is no terminal for the bar.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    screen = Screen(stderr=True)
    with Progress(*columns, console=screen, disable=not screen.is_terminal or is_quiet()) as progress:
        task = progress.add_task(what, total=total)

        def advance(done: int, total: int | None = None) -> None:
            progress.update(task, completed=done, total=total)

        yield advance, lambda line: None if is_quiet() else screen.print(escape(line), highlight=False, soft_wrap=True)
