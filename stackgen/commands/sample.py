"""stackgen sample: silhouettes to stacks, with verdicts, pictures and 3-D files."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from stackgen.api import DEFAULT, load
from stackgen.commands import Command, Files
from stackgen.commands.tables import add_entries, verdict_table
from stackgen.export import write_glb
from stackgen.render import contact_sheet, save_image
from stackgen.stack import StackgenError, format_block_list
from stackgen.stacks_file import StacksFile, write_stacks


def main(
    images: list[Path],
    out: Path,
    num_samples: int = 3,
    blocks: str | None = None,
    seed: int = 0,
    weights: str = DEFAULT,
    block_list_weights: str = DEFAULT,
) -> None:
    """Turn silhouettes into stacks of blocks, and let a simulator judge each.

    Args:
        images: Pictures of structures.
        out: Folder for stacks.json, stacks.png and a GLB for each stack; with several images, a folder in it for each.
        num_samples: Stacks for each image.
        blocks: Block list, such as cube=3,rectangle=2; chosen by the network by default.
        seed: Same seed, same stacks.
        weights: Of the sampler: a name, a .safetensors, a .ckpt or the folder of a run.
        block_list_weights: Of the block-list network, likewise.
    """
    if num_samples < 1:
        raise StackgenError(f"--num_samples must be at least 1, got {num_samples}")
    folders = result_folders(images, out)
    model = load(weights, block_list_weights)
    # Mistakes come to light before any work is done.
    _ = model.predictor if blocks is None else model.counts(blocks)
    for image in images:
        model.read(image)
    table, finished = verdict_table("image"), 0
    screen = Console(stderr=True)
    with Progress(console=screen, transient=True, disable=not screen.is_terminal) as progress:
        task = progress.add_task("", total=len(images) * (num_samples + 2))
        try:
            for image, folder in zip(images, folders, strict=True):
                progress.update(task, description=image.name)
                result = model.sample_checked(image, num_samples, seed, blocks, lambda: progress.advance(task))
                write_result(result, folder)
                progress.advance(task)
                finished += 1
                add_entries(table, image.name, result.entries, most=1)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{finished} of {len(images)} images are finished in {out}") from None
    console = Console()
    console.print(table)
    console.print(f"wrote {out}", highlight=False)


def result_folders(images: Sequence[Path], out: Path) -> list[Path]:
    """A folder for each image: `out` itself for one, else one in it, named like the image; equal names are numbered.

    Raises:
        StackgenError: If no folder can be made there.

    >>> [folder.name for folder in result_folders([Path("a.png"), Path("b/a.jpg")], Path("no-such-folder"))]
    ['a', 'a-2']
    """
    there = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise StackgenError(f"--out {out}: {there} is {'not writable' if there.is_dir() else 'not a folder'}")
    if len(images) == 1:
        return [out]
    names: list[str] = []
    for image in images:
        candidates = chain([image.stem], (f"{image.stem}-{number}" for number in count(2)))
        names.append(next(name for name in candidates if name not in names))
    return [out / name for name in names]


def write_result(result: StacksFile, folder: Path) -> None:
    """Write stacks.json, stacks.png and stack-N.glb; all of them appear, or none."""
    assert result.block_list is not None
    title = f"{result.silhouette}: {format_block_list(result.block_list, result.catalogue)}"
    verdicts = [entry.verdict for entry in result.entries]
    ious = [entry.front_iou for entry in result.entries]
    with staged(folder) as stage:
        for number, stack in enumerate(result.stacks, 1):
            write_glb(stage / f"stack-{number}.glb", stack, cell_size=result.cell_size)
        save_image(
            stage / "stacks.png", contact_sheet(result.target, result.stacks, verdicts, ious, title, result.grid)
        )
        write_stacks(stage / "stacks.json", result)


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """A temporary folder whose files move to `folder` when all are written, and vanish otherwise.

    GLBs of an earlier, larger result in the same folder are removed then.
    """
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    stage = Path(tempfile.mkdtemp(prefix=".stackgen-", dir=folder))
    try:
        yield stage
        files = {file.name: file for file in stage.iterdir()}
        for old in folder.glob("stack-[0-9]*.glb"):
            if old.name not in files:
                old.unlink()
        for name, file in files.items():
            os.replace(file, folder / name)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if new and not any(folder.iterdir()):
            folder.rmdir()


COMMAND = Command(
    "sample",
    main,
    """
    stackgen sample examples/silhouettes/arch.png --out out/arch
    stackgen sample sketch.jpg --blocks cube=3,rectangle=2,triangle=1 --num_samples 5 --out out/sketch
    """,
    files=Files("images", "IMAGE", "Pictures of structures: PNG or JPEG, any size, colours and polarity.", many=True),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    # A few stacks keep one thread busy; more only wait for each other, and for whoever else uses the machine.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return COMMAND.run(argv)
