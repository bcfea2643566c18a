"""What is in a dataset, for people: plots, and paragraphs of its card."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stackgen.data.card import markdown_table
from stackgen.data.inspection.contents import SAME, Contents, distributions
from stackgen.geometry import silhouette_iou
from stackgen.io.files import write_atomically
from stackgen.io.text import in_a_plot, in_markdown
from stackgen.viz.render import Picture, contact_sheet

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

TALLIES = ("split", "blocks by shape", "stacks by blocks", "stacks by removals", "stacks by height [cell]")
"""Those of :func:`stackgen.data.inspection.contents.counts` that are drawn as bars."""

_BAR, _INK = "#5494da", "#2c303a"


def draw_facts(path: Path, contents: Contents, found: Mapping[str, Any], margins: Floats | None) -> None:
    """Draw counts and distributions as one PNG.

    Args:
        path: File to write.
        contents: The dataset.
        found: Facts about it, from :func:`stackgen.data.inspection.contents.facts`.
        margins: Margins of some stacks [degrees], if known.

    Raises:
        StackgenError: If it cannot be written.
    """
    from matplotlib.figure import Figure  # without pyplot: no window is ever asked for

    bars = {name: found["counts"][name] for name in TALLIES if name in found["counts"]}
    curves = distributions(contents)
    if margins is not None:
        curves["margin: tilt survived [degrees]"] = margins
    rows = -(-(len(bars) + len(curves)) // 3)
    figure = Figure(figsize=(12, 3 * rows), layout="constrained")
    places = figure.subplots(rows, 3, squeeze=False).ravel()
    for place, (name, tally) in zip(places, bars.items(), strict=False):
        _bars(place, name, tally)
    for place, (name, values) in zip(places[len(bars) :], curves.items(), strict=False):
        _histogram(place, name, values)
    for place in places[len(bars) + len(curves) :]:
        place.set_axis_off()
    figure.suptitle(in_a_plot(f"{found['name']}: {found['stacks']:,} stacks"), color=_INK)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110, metadata={"Software": None})
    write_atomically(path, data.getvalue())


def _bars(axes: Axes, name: str, tally: Mapping[str, int]) -> None:
    bars = axes.bar([in_a_plot(name) for name in tally], list(tally.values()), color=_BAR)
    axes.bar_label(bars, [f"{n:,}" for n in tally.values()], fontsize=7, color=_INK)
    _style(axes, name)


def _histogram(axes: Axes, name: str, values: Floats) -> None:
    """Draw what lies between the percentiles that leave out a thousandth on either side; name the largest."""
    low, high = np.percentile(values, [0.1, 99.9])
    inside = values[(values >= low) & (values <= high)]
    heights = axes.hist(inside, bins=60, color=_BAR)[0]
    if np.max(heights) > 100 * np.median(heights):
        axes.set_yscale("log")
    axes.set_xlabel(f"largest magnitude {np.abs(values).max():.3g}", fontsize=7, color=_INK)
    _style(axes, name)


def _style(axes: Axes, name: str) -> None:
    axes.set_title(name, fontsize=9, color=_INK)
    axes.tick_params(labelsize=7, colors=_INK)
    axes.spines[["top", "right"]].set_visible(False)


def draw_samples(contents: Contents, number: int = 24, seed: int = 0) -> Picture:
    """Draw a contact sheet of random stacks.

    Args:
        contents: The dataset.
        number: Largest number of stacks.
        seed: Seed of the draw.
    """
    size = min(number, len(contents.arrays))
    chosen = np.sort(np.random.default_rng(seed).choice(len(contents.arrays), size, replace=False))
    manifest, stacks = contents.manifest, [contents.stack(i) for i in chosen]
    title = f"{size} of {len(contents.arrays):,} stacks of {manifest.name}, drawn at random"
    ious: list[float | None] | None = None
    if manifest.of_drawings:
        targets = contents.arrays.images(chosen)
        ious = [silhouette_iou(s, t, manifest.world.grid) for s, t in zip(stacks, targets, strict=True)]
    return contact_sheet(None, stacks, ious=ious, title=title, grid=manifest.world.grid)


def paragraphs(found: Mapping[str, Any], pictures: Sequence[str] = ()) -> list[str]:
    """Write the facts as Markdown.

    Args:
        found: Facts from :func:`stackgen.data.inspection.contents.facts`.
        pictures: Names of the pictures beside the card.
    """
    parts = [f"![{name.partition('.')[0]}]({name})" for name in pictures]
    parts += [_tally(name, tally) for name, tally in found["counts"].items()]
    return [*parts, _distributions(found), duplicate_words(found), *nearness_words(found)]


def _tally(name: str, tally: Mapping[str, int]) -> str:
    return markdown_table([name, *map(in_markdown, tally)], [["number", *(f"{n:,}" for n in tally.values())]])


def _distributions(found: Mapping[str, Any]) -> str:
    columns = ("mean", "std", "p1", "median", "p99", "largest")
    rows = [[name, *(f"{values[c]:.4f}" for c in columns)] for name, values in found["distributions"].items()]
    table = markdown_table(["of all blocks", "mean", "std", "1 %", "median", "99 %", "largest magnitude"], rows)
    return f"{table}\n\n{words}" if (words := margin_words(found)) else table


def margin_words(found: Mapping[str, Any]) -> str:
    """Say how stable the stacks are; empty where that is not known."""
    margins = found.get("margins")
    if not margins:
        return ""
    shares = ", ".join(
        f"{100 * share:.1f} % {name.removeprefix('share ')}"
        for name, share in margins.items()
        if name.startswith("share")
    )
    return (
        f"Margins, the largest tilt of the ground that statics says a stack survives, of {margins['stacks']} stacks: "
        f"median {margins['median']:.1f} degrees, {shares}."
    )


def duplicate_words(found: Mapping[str, Any]) -> str:
    """Say how many stacks are there twice."""
    twins = found["duplicates"]
    return (
        f"Duplicates (same shapes, all poses within {SAME:g} cell and rad): {twins['stacks']:,} stacks have a twin, "
        f"{twins['surplus']:,} could go, {twins['across splits']:,} have a twin in another split."
    )


def nearness_words(found: Mapping[str, Any]) -> list[str]:
    """Say how near the frozen test scenes are to the training split; empty where that is not known."""
    if "testset" not in found:
        return []
    near = found["testset"]
    if near is None:
        return ["`testset-v1` is of another world or there is nothing to train on: nothing to compare."]
    scenes = near["scenes"]

    def share(name: str) -> str:
        return f"{near[name]} of {scenes} ({100 * near[name] / scenes:.1f} %)"

    near_most = near["nearest silhouette, IoU"]
    return [
        "Of the scenes of `testset-v1`, counting mirror images as the same, the training split holds: the layout "
        f"(the shapes of each layer from left to right) of {share('layout in training')}; the design (the cells as "
        f"well) of {share('design in training')}; the very stack (within {SAME:g}) of {share('stack in training')}; "
        f"the silhouette, pixel by pixel, of {share('silhouette in training')}. The training silhouette most like a "
        f"scene's has an IoU of {near_most['mean']:.3f} with it in the mean, {near_most['p1']:.3f} at the first "
        "percentile."
    ]
