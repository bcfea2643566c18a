"""The block-list CNN: its table of classes, its architecture, and a fit."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from stackgen._lightning import pl
from stackgen.data.arrays import StackArrays
from stackgen.data.datamodule import StackDataModule
from stackgen.models.blocklist import BlockListNetwork, CNNConfig, CNNPredictor, Residual, all_block_lists
from stackgen.models.cnn import BlockListCNN
from stackgen.models.optimization import OptimizerConfig
from stackgen.stack import StackgenError
from stackgen.weights import export_checkpoint, load_predictor
from tests.models.conftest import trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")

SMALL = CNNConfig(channels=8, layers=1, stem_stride=4, pool=8, hidden=32)


# The classes.


@pytest.mark.parametrize(("shapes", "blocks"), [(1, 1), (1, 10), (2, 3), (4, 10), (3, 5)])
def test_there_is_a_class_for_every_multiset_in_lexicographic_order(shapes: int, blocks: int) -> None:
    wanted = [c for c in itertools.product(range(blocks + 1), repeat=shapes) if 1 <= sum(c) <= blocks]
    assert [tuple(row) for row in all_block_lists(shapes, blocks).tolist()] == wanted
    assert len(wanted) == math.comb(shapes + blocks, shapes) - 1


def test_the_paper_s_world_has_a_thousand_classes() -> None:
    assert len(all_block_lists(4, 10)) == math.comb(14, 4) - 1 == 1000
    assert BlockListNetwork(CNNConfig(layers=1)).out.out_features == 1000


def test_a_list_s_class_is_its_place_in_the_table() -> None:
    network = BlockListNetwork(SMALL)
    assert network.classes(network.lists).tolist() == list(range(1000))
    shuffled = torch.randperm(1000)
    assert (network.classes(network.lists[shuffled]) == shuffled).all()


@pytest.mark.parametrize("counts", [[0, 0, 0, 0], [11, 0, 0, 0], [5, 5, 5, 5]])
def test_a_list_without_a_class_is_refused(counts: list[int]) -> None:
    with pytest.raises(StackgenError, match="1 to 10 blocks"):
        BlockListNetwork(SMALL).classes(torch.tensor([[1, 0, 0, 0], counts]))


def test_worlds_of_too_many_lists_are_refused() -> None:
    with pytest.raises(StackgenError, match="too many"):
        all_block_lists(10, 20)


# The network.


def test_the_paper_s_network() -> None:
    """Ten channels at full size through thirty residual layers, max pooling, two fully connected layers."""
    network = BlockListNetwork(CNNConfig())
    layers = [layer for layer in network.layers if isinstance(layer, Residual)]
    assert len(layers) == 30 and network.stem.out_channels == 10
    shapes: list[torch.Size] = []
    for part in (network.stem, layers[0], layers[-1], network.pool, network.hidden, network.out):
        part.register_forward_hook(lambda module, args, out: shapes.append(out.shape))
    network(torch.zeros(2, 64, 64))
    assert [tuple(shape) for shape in shapes] == [
        (2, 10, 64, 64), (2, 10, 64, 64), (2, 10, 64, 64), (2, 10, 8, 8), (2, 512), (2, 1000)
    ]  # fmt: skip
    kinds = {type(module) for module in network.modules()}
    assert nn.AdaptiveMaxPool2d in kinds and nn.AvgPool2d not in kinds


def test_a_residual_layer_with_silent_convolutions_passes_on_what_is_positive() -> None:
    layer = Residual(3).eval()
    nn.init.zeros_(layer.conv2.weight)
    x = torch.randn(2, 3, 5, 5)
    assert torch.allclose(layer(x), x.clamp(min=0))


class Known(nn.Module):
    """Logits that rise with the class, from the class that the picture's pixel count names."""

    def __init__(self, network: BlockListNetwork) -> None:
        super().__init__()
        self.lists = network.lists

    def forward(self, silhouettes: Tensor) -> Tensor:
        first = silhouettes.sum((1, 2)).long()
        return -(torch.arange(1000) - first[:, None]).abs().float()


def test_predictions_are_the_lists_of_the_best_classes() -> None:
    network = BlockListNetwork(SMALL)
    predictor = CNNPredictor(Known(network))  # type: ignore[arg-type]
    wanted = np.array([3, 500, 998] * 200)  # more than one batch
    pictures = np.zeros((600, 4096), bool)
    for picture, count in zip(pictures, wanted, strict=True):
        picture[:count] = True
    lists = network.lists.numpy()
    found = predictor.predict(pictures.reshape(-1, 64, 64), top=3)
    assert found.shape == (600, 3, 4)
    assert (found[:, 0] == lists[wanted]).all()
    for row, first in zip(found[:3], wanted, strict=False):
        assert {tuple(c) for c in row} == {tuple(c) for c in lists[first - 1 : first + 2]}
    assert (predictor.predict(pictures[:2].reshape(-1, 64, 64)) == found[:2, :1]).all()


# A fit.


def test_it_learns_and_every_form_of_it_predicts_alike(compact: Path, arrays: StackArrays, tmp_path: Path) -> None:
    pl.seed_everything(0, verbose=False)
    module = BlockListCNN(SMALL, OptimizerConfig(learning_rate=1e-2, warmup=2))
    data = StackDataModule(compact, batch_size=16)
    trainer = trainer_for(tmp_path, max_epochs=30, enable_checkpointing=True)
    trainer.fit(module, data)
    images, counts = arrays.images(slice(32)), arrays.counts[:32]
    predictor = module.predictor()
    module.eval()
    assert (predictor.predict(images)[:, 0] == counts).all(axis=1).mean() > 0.9  # of its own training pictures
    metrics = trainer_for(tmp_path).validate(module, data, verbose=False)[0]
    assert set(metrics) == {"validation/loss", "validation/exact", "validation/top3"}
    assert 0 <= metrics["validation/exact"] <= metrics["validation/top3"] <= 1
    trainer.save_checkpoint(tmp_path / "cnn.ckpt")
    export_checkpoint(tmp_path / "cnn.ckpt", tmp_path / "cnn.safetensors")
    for name in ("cnn.ckpt", "cnn.safetensors"):
        loaded = load_predictor(tmp_path / name)
        assert (loaded.predict(images, top=3) == predictor.predict(images, top=3)).all()


def test_metrics_are_shares_of_the_truth() -> None:
    """Exact match is the most likely class, top 3 any of the three."""
    module = BlockListCNN(SMALL)
    module.build()
    known = Known(module.model)
    module.model.forward = lambda silhouettes: known(silhouettes)  # type: ignore[method-assign]
    pictures = torch.zeros(4, 64, 64).flatten(1)
    for picture, count in zip(pictures, (10, 20, 30, 40), strict=True):
        picture[:count] = 1
    truth = module.model.lists[torch.tensor([10, 21, 29, 300])]
    loss, hits = module._loss({"silhouette": pictures.reshape(4, 64, 64), "counts": truth})
    assert hits[:, 0].tolist() == [True, False, False, False]
    assert hits.any(-1).tolist() == [True, True, True, False]
    assert loss > 0
