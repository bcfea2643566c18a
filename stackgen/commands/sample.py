"""stackgen sample: silhouettes to stacks, with verdicts, pictures and 3-D files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

# What sampling itself needs is imported by `main`: the help is to be there at once.
from stackgen.commands.parsing import Command, Files
from stackgen.errors import StackgenError
from stackgen.models.diffusion.settings import SamplerConfig
from stackgen.names import DEFAULT, CheckerName, Preference
from stackgen.vision.options import PictureOptions


def main(
    picture: PictureOptions,
    images: list[Path],
    out: Path,
    num_samples: int = 3,
    blocks: str | None = None,
    inventory: str | None = None,
    seed: int = 0,
    cells: str = "auto",
    prefer: Preference = "fit",
    one_shot: bool = False,
    weights: str = DEFAULT,
    block_list_weights: str = DEFAULT,
    sampler: SamplerConfig = SamplerConfig(),  # noqa: B008 - frozen
    verify: CheckerName | None = None,
    budget: str | None = None,
) -> int:
    """Turn pictures into stacks of blocks and simulate each; the exit code is 1 if any falls, but for single samples.

    Search and network look for the best stacks together. Single samples of the network alone, as the paper has them,
    are drawn with --one_shot or with any option that says which weights sample, or how.

    Args:
        picture: What the user says of the pictures.
        images: Pictures of structures.
        out: Folder for stacks.json, stacks.png, silhouette.png, overlay.png and a GLB for each stack; several images
            get a folder each in it, beside overview.png.
        num_samples: Number of stacks for each image.
        blocks: Block list, such as cube=3,rectangle=2; it is chosen by default.
        inventory: Blocks that are available, such as cube=4,rectangle=3; the block list is chosen among them.
        seed: Seed of the samples: the same seed gives the same stacks, unless --budget is a time.
        cells: Height of the structure in cells, such as 6, or width and height, such as 6x5; auto finds it, up to 8, or
            fills the grid of weights that are named.
        prefer: Stacks that come first: those of the best fit, or of those that fit nearly as well the ones of the
            largest margin against tilting.
        weights: Weights of the sampler: a name (search is one), a .safetensors file, a .ckpt file or a run folder.
        block_list_weights: Weights of the block-list network: a name, a .safetensors file, a .ckpt file or a run
            folder; those that ship for the sampler's world by default.
        sampler: Settings by which a diffusion model samples; the weights' own where one is null.
        verify: Verified sampling: many stacks are drawn and checked by the simulator (the default after --verify
            alone) or by statics, and the best are kept; where nothing stands, the next likely block list is tried.
        budget: Limit for each image: a time, such as 1s, or a number of stacks that are judged, such as 400 (the
            default); with --verify a number of draws for each block list, such as 64 (the default).
    """
    from stackgen.api import best, load
    from stackgen.commands.sample_pictures import answer_all, of_model, result_folders
    from stackgen.io.stacks_file import StacksFile
    from stackgen.sampling.best import within
    from stackgen.sampling.verified import Budget
    from stackgen.search.scale import Cells
    from stackgen.vision.reader import Reading

    if num_samples < 1:
        raise StackgenError(f"--num_samples must be at least 1, got {num_samples}")
    folders = result_folders(images, out)
    asked: dict[str, Any] = {"num_samples": num_samples, "seed": seed, "blocks": blocks, "inventory": inventory}
    height = Cells.parse(cells)
    own = one_shot or verify is not None or sampler != SamplerConfig()
    if own or weights != DEFAULT or block_list_weights != DEFAULT:
        if prefer != "fit":
            raise StackgenError("--prefer belongs to the search: leave out what asks for single samples")
        draw = of_model(load(weights, block_list_weights, sampler), asked, verify, budget, height)
    else:
        search = within(None if budget is None else Budget.parse(budget), prefer)

        def draw(image: Path, reading: Reading) -> StacksFile:
            return replace(best(reading, **asked, cells=cells, search=search), silhouette=image.name)

    return answer_all(
        images, folders, picture, out, draw, verified=not (own or weights != DEFAULT) or verify is not None
    )


COMMAND = Command(
    "sample",
    main,
    """
    stackgen sample examples/silhouettes/arch.png --out out/arch
    stackgen sample sketch.jpg --blocks cube=3,rectangle=2,triangle=1 --num_samples 5 --out out/sketch
    stackgen sample sketch.jpg --inventory cube=4,rectangle=3 --verify --budget 1s --out out/sketch
    stackgen sample tower.png --cells 6 --prefer margin --out out/tower
    stackgen sample sketch.jpg --sampler.kind dpm --sampler.steps 8 --out out/sketch
    """,
    files=Files("images", "IMAGE", "Pictures of structures: PNG or JPEG, any size, colours and polarity.", many=True),
    settings={"picture": PictureOptions},
    reports=True,
    flags={"one_shot": "Draw single samples of the network, as the paper does."},
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    # A few stacks keep one thread busy; more threads only wait for each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return COMMAND.run(with_checker(argv))


def with_checker(argv: Sequence[str]) -> list[str]:
    """Write out what `--verify` alone means: the simulator.

    >>> with_checker(["a.png", "--verify", "--budget", "1s"])
    ['a.png', '--verify', 'simulator', '--budget', '1s']
    """
    checkers, arguments = get_args(CheckerName), list(argv)
    for place in reversed(range(len(arguments))):
        if arguments[place] == "--verify" and arguments[place + 1 : place + 2] not in [[name] for name in checkers]:
            arguments.insert(place + 1, checkers[0])
    return arguments
