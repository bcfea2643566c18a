"""stackgen show: draw the stacks of a file as a picture and as a page that turns them."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.output import wrote
from stackgen.commands.parsing import Command, Files
from stackgen.errors import StackgenError
from stackgen.io.stacks_file import read_stacks
from stackgen.viz.page import write_html
from stackgen.viz.render import contact_sheet, save_image


def main(file: Path, out: Path | None = None, open: bool = False) -> None:
    """Draw the stacks of a stacks.json: one picture, and a page that shows them in 3-D.

    Args:
        file: The stacks.json; `-` is standard input.
        out: Picture to write, PNG or JPEG; the page goes beside it as .html. By default both go beside the file.
        open: Whether to open the page in a browser.
    """
    if file == Path("-") and out is None:
        raise StackgenError("standard input has no name to call the picture by: give --out")
    content = read_stacks(file)
    picture = out or file.with_suffix(".png")
    page = picture.with_suffix(".html")
    verdicts = [entry.verdict for entry in content.entries]
    ious = [entry.front_iou for entry in content.entries]
    title = content.silhouette or file.name
    save_image(picture, contact_sheet(content.target, content.stacks, verdicts, ious, title, grid=content.world.grid))
    write_html(page, content.stacks, verdicts, title)
    wrote(picture, page)
    if open:
        webbrowser.open(page.absolute().as_uri())


COMMAND = Command(
    "show",
    main,
    """
    stackgen show out/arch/stacks.json --open
    stackgen show mine.json --out pictures/mine.png
    """,
    files=Files("file", "FILE", "File of stacks (stacks.json); - is standard input."),
    reports=True,
    flags={"open": "Open the page in a browser."},
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
