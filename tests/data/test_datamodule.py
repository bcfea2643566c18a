"""What an epoch is: who is visited, in which order, by which process."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stackgen._lightning import pl
from stackgen.data.arrays import StackArrays
from stackgen.data.compact import save_npz
from stackgen.data.datamodule import StackDataModule
from stackgen.data.decoding import bytes_per_sample
from stackgen.data.loading.cached import CachedLoader
from stackgen.errors import StackgenError
from stackgen.world import PAPER_WORLD


def _place(rank: int, world: int = 3) -> tuple[int, int]:
    return rank, world


def visited(loader: Any) -> list[int]:
    """Templates (here a sample's number) in the order of an epoch."""
    return [t for batch in loader for t in batch["template"].tolist()]


def test_a_training_epoch_visits_every_sample_once_up_to_a_last_partial_batch(splits: dict[str, StackArrays]) -> None:
    arrays = splits["train"]
    loader = CachedLoader(arrays, 1, train=True)
    assert sorted(visited(loader)) == sorted(arrays.template.tolist())
    loader = CachedLoader(arrays, 16, train=True)
    order = visited(loader)
    assert len(loader) == 71 // 16 and len(order) == len(set(order)) == 71 // 16 * 16


def test_buckets_hold_one_number_of_blocks_and_no_padding(splits: dict[str, StackArrays]) -> None:
    arrays = splits["train"]
    loader = CachedLoader(arrays, 8, train=True, bucket_by_blocks=True)
    batches = list(loader)
    assert len(batches) == len(loader)
    assert all(batch["mask"].all() and batch["poses"].shape[1] == batch["shapes"].shape[1] for batch in batches)
    assert len({batch["shapes"].shape[1] for batch in batches}) == len(set(arrays.lengths.tolist()))
    for batch in batches:
        plain = arrays.batch([arrays.template.tolist().index(t) for t in batch["template"].tolist()])
        assert torch.equal(plain["poses"][:, : batch["poses"].shape[1]], batch["poses"])


def test_order_and_reflections_depend_on_seed_and_epoch_alone(splits: dict[str, StackArrays]) -> None:
    def epoch(number: int, seed: int = 0) -> list[Any]:
        loader = CachedLoader(
            splits["train"], 16, train=True, mirror=True, bucket_by_blocks=True, seed=seed, epoch=lambda: number
        )
        return [(b["template"].tolist(), b["poses"].numpy().tobytes()) for b in loader]

    assert epoch(3) == epoch(3)
    assert epoch(3) != epoch(4) and epoch(3) != epoch(3, seed=1)
    counting = CachedLoader(splits["train"], 16, train=True)
    assert visited(counting) != visited(counting)


def test_mirrored_batches_hold_each_sample_or_its_mirror_image_half_of_the_time(splits: dict[str, StackArrays]) -> None:
    arrays = splits["train"]
    loader = CachedLoader(arrays, 71, train=True, mirror=True)
    place = {t: i for i, t in enumerate(arrays.template.tolist())}
    sign, images = np.array([-1, 1, 1, 1, -1, -1], np.float32), arrays.images()
    flips = []
    for _ in range(20):
        for batch in loader:
            for t, poses, image in zip(batch["template"].tolist(), batch["poses"], batch["silhouette"], strict=True):
                i = place[t]
                flipped = not np.array_equal(poses, arrays.poses[i])
                if flipped:
                    assert np.array_equal(poses, arrays.poses[i] * sign)
                assert np.array_equal(image.numpy() > 0, images[i][:, ::-1] if flipped else images[i])
                flips.append(flipped)
    assert len(flips) == 20 * 71 and 0.45 < np.mean(flips) < 0.55


def test_epochs_of_another_length_are_cut_from_one_row_of_passes(splits: dict[str, StackArrays]) -> None:
    whole = CachedLoader(splits["train"], 16, train=True, seed=5)
    cut = CachedLoader(splits["train"], 16, train=True, seed=5, samples_per_epoch=50)
    assert len(cut) == 3
    passes = [t for _ in range(3) for t in visited(whole)]
    epochs = [t for _ in range(4) for t in visited(cut)]
    assert epochs == passes[: 4 * 48]


def test_ranks_of_a_loader_do_not_overlap(splits: dict[str, StackArrays]) -> None:
    for train in (True, False):
        shares = [
            visited(CachedLoader(splits["train"], 8, train=train, rank=partial(_place, rank))) for rank in range(3)
        ]
        together = [t for share in shares for t in share]
        assert len(together) == len(set(together))
        assert sorted(together) == splits["train"].template.tolist() or train


def test_validation_and_test_visit_every_sample_once_in_order(
    dataset: Path, splits: dict[str, StackArrays], tmp_path: Path
) -> None:
    data = StackDataModule(dataset, batch_size=10, eval_batch_size=6, test_path=dataset)
    data.setup("fit")
    assert visited(data.val_dataloader()) == splits["validation"].template.tolist()
    assert visited(data.test_dataloader()) == splits["test"].template.tolist()
    assert data.world.catalogue.names[0] == "cube" and data.world.grid.image_size == 64
    save_npz(tmp_path / "d.npz", splits, data.manifest)
    compact = StackDataModule(tmp_path / "d.npz", batch_size=10)
    assert compact.manifest == data.manifest
    assert visited(compact.train_dataloader()) == visited(data.train_dataloader())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "at least 1"),
        ({"mode": "cached", "num_workers": 2}, "mode stream"),
        ({"num_workers": -1}, "must not be negative"),
        ({"path": "nowhere.npz"}, "no dataset at nowhere.npz"),
        ({"path": "nowhere"}, "no dataset at nowhere"),
    ],
)
def test_bad_options_are_one_line(dataset: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(StackgenError, match=message) as caught:
        StackDataModule(**{"path": dataset, **options}).setup("fit")
    assert "\n" not in str(caught.value)


class _Recorder(pl.LightningModule):
    """Learns nothing, but remembers what it saw."""

    def __init__(self, stop_at: int | None = None) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[list[int]] = []
        self.stop_at = stop_at

    def training_step(self, batch: dict[str, torch.Tensor], batch_idx: int) -> torch.Tensor:
        if len(self.seen) == self.stop_at:
            raise KeyboardInterrupt
        self.seen.append(batch["template"].tolist())
        return self.weight.sum() * 0

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def _fit(
    module: pl.LightningModule, data: StackDataModule, folder: Path, resume: Path | None = None, **options: Any
) -> pl.Trainer:
    trainer = pl.Trainer(
        default_root_dir=folder, accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False,
        callbacks=[pl.callbacks.ModelCheckpoint(folder, every_n_train_steps=1, save_last=True)], **options,
    )  # fmt: skip
    trainer.fit(module, data, ckpt_path=resume)
    return trainer


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("options", [{}, {"mode": "stream"}, {"samples_per_epoch": 40}], ids=str)
@pytest.mark.parametrize("beyond", [0, 3])
def test_a_fit_resumed_in_the_middle_of_an_epoch_sees_the_batches_it_would_have_seen(
    dataset: Path, tmp_path: Path, options: dict[str, Any], beyond: int
) -> None:
    def data() -> StackDataModule:
        return StackDataModule(dataset, batch_size=8, bucket_by_blocks=True, mirror=True, **options)

    whole, first, second = _Recorder(), _Recorder(), _Recorder()
    _fit(whole, data(), tmp_path / "a", max_steps=20)
    stop = len(data().train_dataloader()) + beyond
    _fit(first, data(), tmp_path / "b", max_steps=stop)
    _fit(second, data(), tmp_path / "b", tmp_path / "b" / "last.ckpt", max_steps=20)
    assert first.seen == whole.seen[:stop]
    assert second.seen == whole.seen[stop:]


class _Validated(_Recorder):
    """Counts validations too."""

    def __init__(self) -> None:
        super().__init__()
        self.validated: list[int] = []

    def validation_step(self, batch: dict[str, torch.Tensor], batch_idx: int) -> None:
        self.validated += batch["template"].tolist()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("before", "after", "batches"), [(8, 16, 4), (16, 8, 8)])
def test_a_fit_resumed_with_another_batch_size_finishes_the_epoch_exactly(
    dataset: Path, tmp_path: Path, before: int, after: int, batches: int
) -> None:
    """71 samples. The same goes on with another number of processes, which Lightning cannot change in a test."""
    first, second = _Validated(), _Validated()
    _fit(first, StackDataModule(dataset, batch_size=before), tmp_path, max_steps=2)
    _fit(second, StackDataModule(dataset, batch_size=after), tmp_path, tmp_path / "last.ckpt", max_epochs=3)
    rest = (71 - 2 * before) // after
    epoch = [t for batch in (*first.seen, *second.seen[:rest]) for t in batch]
    assert len(epoch) == len(set(epoch)) == 2 * before + rest * after  # nobody twice, all that fill a batch
    assert [len(batch) for batch in second.seen] == [after] * (rest + 2 * batches)
    for number in range(2):  # the next epochs are whole ones
        start = rest + number * batches
        seen = [t for batch in second.seen[start : start + batches] for t in batch]
        assert len(set(seen)) == batches * after
    assert len(second.validated) >= 3 * 23


# Resumed under another layout, without a trainer.


@pytest.mark.parametrize("bucketed", [False, True])
@pytest.mark.parametrize(("worlds"), [(2, 1), (1, 3), (3, 2, 1), (2, 2)])
def test_an_epoch_in_memory_is_finished_exactly_on_any_number_of_processes(
    splits: dict[str, StackArrays], worlds: tuple[int, ...], bucketed: bool
) -> None:
    state, seen = None, Counter[int]()
    for turn, world in enumerate(worlds):
        loaders = [
            CachedLoader(
                splits["train"],
                4,
                train=True,
                bucket_by_blocks=bucketed,
                epoch=lambda: 5,
                rank=partial(_place, rank, world),
            )
            for rank in range(world)
        ]
        if state is not None:
            for loader in loaders:
                loader.load_state_dict(state)
        assert len({len(loader) for loader in loaders}) == 1
        last = turn == len(worlds) - 1
        lengths = set()
        for loader in loaders:
            shown = 0
            for batch in loader:
                seen.update(batch["template"].tolist())
                shown += 1
                if not last and shown == 2:
                    break
            lengths.add(shown)
        assert len(lengths) == 1
        state = loaders[0].state_dict()
    assert max(seen.values()) == 1
    together = 4 * worlds[-1]
    assert 71 - len(seen) < (together if not bucketed else 7 * together)


def test_an_epoch_that_was_finished_is_not_begun_again(splits: dict[str, StackArrays]) -> None:
    one, two = (CachedLoader(splits["train"], 16, train=True) for _ in range(2))
    visited(one)
    two.load_state_dict(one.state_dict())
    assert visited(two) == []
    assert visited(two) == visited(one)


# What is held in memory.


def test_what_fits_is_cached_and_what_does_not_is_streamed(dataset: Path) -> None:
    each = bytes_per_sample(PAPER_WORLD)
    assert each == 10 * 25 + 512 + 8 * 6
    needed = {"train": (71 + 23) * each / 1e9, "validation": 23 * each / 1e9}

    def choice(limit: float, mode: str = "auto") -> list[bool]:
        data = StackDataModule(dataset, mode=mode, cache_gb=limit, test_path=dataset)  # type: ignore[arg-type]
        data.setup("fit")
        kinds = [type(loader).__name__ for loader in (data.train_dataloader(), data.val_dataloader())]
        assert kinds == [
            "CachedLoader" if data.is_cached("train") else "TrainingStream",
            "CachedLoader" if data.is_cached("validation") else "ExactStream",
        ]
        return [data.is_cached("train"), data.is_cached("validation")]

    assert choice(2.0) == choice(needed["train"]) == choice(0, "cached") == [True, True]
    assert choice(needed["train"] * 0.99) == choice(needed["validation"]) == [False, True]
    assert choice(needed["validation"] * 0.99) == choice(9.0, "stream") == [False, False]


def test_a_stream_knows_the_scale_of_the_poses(dataset: Path, splits: dict[str, StackArrays]) -> None:
    streamed = StackDataModule(dataset, mode="stream", mirror=True).pose_statistics()
    assert all(map(np.array_equal, streamed, splits["train"].pose_statistics(mirror=True)))  # it has two shards only


def test_memory_counted_is_memory_taken(splits: dict[str, StackArrays]) -> None:
    arrays = splits["train"]
    parts = (arrays.shapes, arrays.poses, arrays.silhouettes, arrays.template, arrays.counts, arrays.lengths)
    assert sum(part.nbytes for part in parts) == len(arrays) * bytes_per_sample(PAPER_WORLD)


DISTRIBUTED = """
import json, sys
import torch
from stackgen._lightning import pl
from stackgen.data.datamodule import StackDataModule

class Model(pl.LightningModule):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.seen = {"train": [], "validation": [], "test": []}
    def step(self, name, batch):
        self.seen[name].append(batch["template"].tolist())
        self.log(name, float(len(batch["template"])), sync_dist=True, on_step=name == "train", on_epoch=True)
        return self.weight.sum() * 0
    def training_step(self, batch, _): return self.step("train", batch)
    def validation_step(self, batch, _): self.step("validation", batch)
    def test_step(self, batch, _): self.step("test", batch)
    def configure_optimizers(self): return torch.optim.SGD(self.parameters(), lr=0.1)

folder, mode, workers, out = sys.argv[1:]
data = StackDataModule(folder, 8, mode=mode, num_workers=int(workers), test_path=folder, eval_batch_size=3)
trainer = pl.Trainer(
    accelerator="cpu", devices=2, strategy="ddp_fork", max_epochs=2, logger=False, enable_checkpointing=False,
    enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
)
class Keep(pl.Callback):
    def on_fit_end(self, trainer, module):
        with open(f"{out}/{trainer.global_rank}.json", "w") as file:
            json.dump(module.seen, file)
trainer.callbacks.append(Keep())
trainer.fit(Model(), data)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "workers"), [("cached", 0), ("stream", 0), ("stream", 1)])
@pytest.mark.parametrize("damaged", [False, True])
def test_two_processes_of_lightning_see_everyone_once_and_none_waits(
    dataset: Path, tmp_path: Path, mode: str, workers: int, damaged: bool
) -> None:
    folder = tmp_path / "data"
    shutil.copytree(dataset, folder)
    if damaged:
        if mode == "cached":
            pytest.skip("memory refuses it before training begins")
        (folder / "train-000001.tar").write_bytes(b"")
    command = [sys.executable, "-c", DISTRIBUTED, str(folder), mode, str(workers), str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, cwd=Path(__file__).parents[2]
    )
    assert done.returncode == 0, done.stderr
    ranks = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2)]
    for name in ("train", "validation"):
        assert len(ranks[0][name]) == len(ranks[1][name]) > 0
        half = len(ranks[0][name]) // 2
        for epoch in (slice(half), slice(half, None)):
            seen = [t for rank in ranks for batch in rank[name][epoch] for t in batch]
            if name == "validation":
                assert sorted(seen) == list(range(71, 94))
            elif not damaged:
                assert len(seen) == len(set(seen)) == 64
            else:
                assert len(seen) == 64 and set(seen) <= set(range(41)) and "train-000001.tar" in done.stderr
