"""What an epoch is: who is visited, in which order, by which process."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stackgen._lightning import pl
from stackgen.data.arrays import StackArrays, save_npz
from stackgen.data.datamodule import CachedLoader, StackDataModule, exact_batches, training_batches
from stackgen.stack import StackgenError


def _place(rank: int) -> tuple[int, int]:
    return rank, 3


def visited(loader: Any) -> list[int]:
    """Templates (here a sample's number) in the order of an epoch."""
    return [t for batch in loader for t in batch["template"].tolist()]


@given(
    sizes=st.lists(st.integers(1, 60), min_size=1, max_size=4),
    batch_size=st.integers(1, 16),
    world=st.integers(1, 4),
    seed=st.integers(0, 99),
)
@settings(max_examples=100, deadline=None)
def test_processes_share_a_training_pass_without_overlap(
    sizes: list[int], batch_size: int, world: int, seed: int
) -> None:
    ends = np.cumsum([0, *sizes])
    buckets = [np.arange(a, b) for a, b in itertools.pairwise(ends)]
    ranks = [training_batches(buckets, batch_size, np.random.default_rng(seed), (rank, world)) for rank in range(world)]
    assert len({len(batches) for batches in ranks}) == 1
    everyone = np.concatenate([batch for batches in ranks for batch in batches] or [np.arange(0)])
    assert len(set(everyone.tolist())) == len(everyone)
    for bucket in buckets:  # only the rest of a last batch is left out
        left_out = len(bucket) - np.isin(bucket, everyone).sum()
        assert left_out < (batch_size if len(bucket) >= batch_size * world else 1) * world
    for together in zip(*ranks, strict=True):
        of = {int(np.searchsorted(ends, i, side="right")) for batch in together for i in batch}
        assert len(of) == 1  # all processes in the same bucket at the same time
        assert len({len(batch) for batch in together}) == 1


@given(count=st.integers(1, 200), batch_size=st.integers(1, 32), world=st.integers(1, 8))
@settings(max_examples=200, deadline=None)
def test_an_exact_pass_visits_everyone_once_in_equally_many_batches(count: int, batch_size: int, world: int) -> None:
    if count < world:
        with pytest.raises(StackgenError):
            exact_batches(count, batch_size, (0, world))
        return
    ranks = [exact_batches(count, batch_size, (rank, world)) for rank in range(world)]
    assert len({len(batches) for batches in ranks}) == 1
    assert all(1 <= len(batch) <= max(batch_size, 2 if world > 1 else 1) for batches in ranks for batch in batches)
    assert sorted(int(i) for batches in ranks for batch in batches for i in batch) == list(range(count))


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
            visited(CachedLoader(splits["train"], 8, train=train, place=partial(_place, rank))) for rank in range(3)
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
    assert data.catalogue.names[0] == "cube" and data.grid.image_size == 64
    save_npz(tmp_path / "d.npz", splits, data.manifest)
    compact = StackDataModule(tmp_path / "d.npz", batch_size=10)
    assert compact.manifest == data.manifest
    assert visited(compact.train_dataloader()) == visited(data.train_dataloader())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "at least 1"),
        ({"num_workers": 2}, "mode stream"),
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


def _fit(module: _Recorder, dataset: Path, folder: Path, steps: int, resume: Path | None = None) -> None:
    trainer = pl.Trainer(
        default_root_dir=folder, max_steps=steps, accelerator="cpu", logger=False, enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[pl.callbacks.ModelCheckpoint(folder, every_n_train_steps=1, save_last=True)],
    )  # fmt: skip
    data = StackDataModule(dataset, batch_size=8, bucket_by_blocks=True, mirror=True)
    trainer.fit(module, data, ckpt_path=resume)


@pytest.mark.filterwarnings("ignore")
def test_a_fit_resumed_in_the_middle_of_an_epoch_sees_the_batches_it_would_have_seen(
    dataset: Path, tmp_path: Path
) -> None:
    whole, first, second = _Recorder(), _Recorder(), _Recorder()
    _fit(whole, dataset, tmp_path / "a", 20)
    length = len(StackDataModule(dataset, batch_size=8, bucket_by_blocks=True).train_dataloader())  # type: ignore[arg-type]
    stop = length + 3
    _fit(first, dataset, tmp_path / "b", stop)
    _fit(second, dataset, tmp_path / "b", 20, tmp_path / "b" / "last.ckpt")
    assert first.seen == whole.seen[:stop]
    assert second.seen == whole.seen[stop:]
