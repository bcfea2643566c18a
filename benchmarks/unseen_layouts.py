"""Which scenes of testset-v1 have a layout that a training set lacks, for results on what was never seen.

Reads training sets (folders or compact files) and writes, for each, the scenes that it does not hold; `--together`
takes several for one, as a training did. What the file knows of other training sets is kept. It ships with the package,
so that nobody needs the training sets to make the report.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.common import plain_table, start
from stackgen.data.arrays import StackArrays
from stackgen.data.dataset import TESTSET, Dataset
from stackgen.data.inspection.seen_layouts import seen_layouts
from stackgen.evaluation.protocol import scenes_of
from stackgen.evaluation.report.references import SEEN_FILE, SEEN_FORMAT
from stackgen.io.files import write_json
from stackgen.io.text import read_json

NOTIONS = {"designs": True, "layouts": False}
"""Whether the cell in which each block begins counts."""


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argparse.ArgumentParser(
        prog="python -m benchmarks.unseen_layouts", description=(__doc__ or "").partition("\n\n")[0]
    )
    options.add_argument("datasets", type=Path, nargs="+", help="training sets: folders or .npz files")
    options.add_argument("--together", metavar="NAME", help="name of the one training set that they are")
    options.add_argument("--out", type=Path, default=SEEN_FILE, metavar="FILE.json", help="where to write")
    return options


def main() -> None:
    """Compare, print, write."""
    options = parser().parse_args()
    testset = Dataset.open(TESTSET)
    test = testset.split("test")
    datasets = [Dataset.open(path) for path in options.datasets]
    if options.together:
        joined = Dataset.join(datasets)
        entries = [compare(joined, test) | {"name": options.together}]
    else:
        entries = [compare(dataset, test) for dataset in datasets]
    made = {entry["sha256"] for entry in entries}
    entries = [entry for entry in known(options.out, testset) if entry["sha256"] not in made] + entries
    names = [entry["name"] for entry in entries]
    for entry in entries:
        if names.count(entry["name"]) > 1:  # made by other settings of the generator
            entry["name"] += f" {entry['sha256'][:8]}"
    rows = [[entry["name"], str(entry["stacks"]), *(str(len(entry["unseen"][notion])) for notion in NOTIONS)]
            for entry in entries]  # fmt: skip
    heading = ("training set", "stacks", *(f"unseen {notion}" for notion in NOTIONS))
    Console().print(plain_table(f"Of {len(test)} scenes", heading, rows))
    content = {"format": SEEN_FORMAT, "test_set": testset.manifest.sha256, "training_sets": entries}
    write_json(options.out, content, indent=None)


def known(path: Path, testset: Dataset) -> list[dict[str, Any]]:
    """Entries of an earlier file about the same test set."""
    if not path.exists():
        return []
    content = read_json(path)
    return content["training_sets"] if content.get("test_set") == testset.manifest.sha256 else []


def compare(dataset: Dataset, test: StackArrays) -> dict[str, Any]:
    """A training set's entry.

    Raises:
        StackgenError: If it has no training split.
    """
    train = dataset.split("train")
    names = [scene.name for scene in scenes_of(test, dataset.world.catalogue)]
    unseen = {}
    for notion, positions in NOTIONS.items():
        seen = seen_layouts(train, test, dataset.world, positions=positions)
        unseen[notion] = [name for name, known in zip(names, seen, strict=True) if not known]
    return {
        "name": dataset.manifest.name,
        "sha256": dataset.manifest.sha256,
        "stacks": len(train),
        "unseen": unseen,
    }


if __name__ == "__main__":
    start(main)
