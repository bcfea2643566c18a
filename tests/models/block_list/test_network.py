"""The block-list CNN: its two heads, its architecture, and a fit."""

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
from stackgen.errors import StackgenError
from stackgen.models.block_list.heads import ChainHead, ClassHead, all_block_lists, number_of_lists
from stackgen.models.block_list.module import BlockListCNN
from stackgen.models.block_list.network import BlockListNetwork, CNNConfig, Residual
from stackgen.models.block_list.predictor import CNNPredictor
from stackgen.models.optimization import OptimizerConfig
from stackgen.models.weights import export_checkpoint
from stackgen.sampling.methods import load_predictor
from stackgen.world import PAPER_WORLD, Catalogue, Grid, Shape, World
from tests.models.conftest import trainer_for

pytestmark = pytest.mark.filterwarnings("ignore")

SMALL = CNNConfig(channels=8, layers=1, stem_stride=4, pool=8, hidden=32)
SEVEN = Catalogue(tuple(Shape.box(f"box{i}", 1 + i % 4, 1 if i < 5 else 0.5) for i in range(7)))
WIDE = Grid(6, 5, 96, 14, 6)

# The block lists.


@pytest.mark.parametrize(("shapes", "blocks"), [(1, 1), (1, 10), (2, 3), (4, 10), (3, 5)])
def test_there_is_a_class_for_every_multiset_in_lexicographic_order(shapes: int, blocks: int) -> None:
    wanted = [c for c in itertools.product(range(blocks + 1), repeat=shapes) if 1 <= sum(c) <= blocks]
    assert [tuple(row) for row in all_block_lists(shapes, blocks).tolist()] == wanted
    assert len(wanted) == math.comb(shapes + blocks, shapes) - 1 == number_of_lists(shapes, blocks)


def test_the_paper_s_world_has_a_thousand_classes() -> None:
    head = BlockListNetwork(CNNConfig(layers=1), PAPER_WORLD).out
    assert isinstance(head, ClassHead) and head.out_features == math.comb(14, 4) - 1 == 1000


def test_a_list_s_class_is_its_place_in_the_table() -> None:
    head = ClassHead(2, 4, 10)
    assert head.classes(head.lists).tolist() == list(range(1000))
    shuffled = torch.randperm(1000)
    assert (head.classes(head.lists[shuffled]) == shuffled).all()


def test_worlds_of_too_many_lists_have_no_classes_but_a_chain() -> None:
    with pytest.raises(StackgenError, match=r"888029 block lists, too many .* set the network's head to chain"):
        BlockListNetwork(CNNConfig(layers=1, head="classes"), World(SEVEN, WIDE, 20))
    head = BlockListNetwork(SMALL, World(SEVEN, WIDE, 20)).out
    assert isinstance(head, ChainHead) and head.sizes == (8, 6, 4, 3, 2, 2, 2)


# What holds for every head. Weights are far from even, so that wrong orders show.


def head_of(kind: str, shapes: int, blocks: int) -> ClassHead | ChainHead:
    torch.manual_seed(0)
    if kind == "classes":
        head: ClassHead | ChainHead = ClassHead(8, shapes, blocks)
    else:
        head = ChainHead(8, range(1, shapes + 1), blocks, 5)  # areas of more than five are not told apart
    for parameter in head.parameters():
        nn.init.normal_(parameter, std=2)
    return head


def every_list(head: ClassHead | ChainHead, features: Tensor, shapes: int, blocks: int) -> tuple[Tensor, Tensor]:
    """All lists (M, S), and the log-probability of each (B, M)."""
    lists = torch.from_numpy(all_block_lists(shapes, blocks))
    return lists, head.log_probabilities(features, lists.expand(len(features), -1, -1))


@pytest.mark.parametrize("kind", ["classes", "chain"])
@pytest.mark.parametrize(("shapes", "blocks"), [(1, 1), (1, 4), (2, 3), (4, 6)])
def test_probabilities_of_all_lists_add_up_to_one(kind: str, shapes: int, blocks: int) -> None:
    features = torch.randn(3, 8)
    _, found = every_list(head_of(kind, shapes, blocks), features, shapes, blocks)
    assert torch.allclose(found.exp().sum(1), torch.ones(3), atol=1e-5)
    assert shapes * blocks == 1 or found.std() > 0.1


@pytest.mark.parametrize("kind", ["classes", "chain"])
@pytest.mark.parametrize("limit", [None, (6, 6, 6, 6), (1, 0, 2, 1), (0, 3, 0, 0), (2, 9, 0, 5)])
def test_the_best_lists_are_the_best_of_all_that_are_allowed(kind: str, limit: tuple[int, ...] | None) -> None:
    shapes, blocks, top = 4, 6, 7
    head, features = head_of(kind, shapes, blocks), torch.randn(40, 8)
    lists, value = every_list(head, features, shapes, blocks)
    most = None if limit is None else torch.tensor(limit)
    allowed = torch.ones(len(lists), dtype=torch.bool) if most is None else (lists <= most).all(-1)
    found = head.best(features, top, most)
    kept = min(top, int(allowed.sum()))
    assert found.shape == (40, kept, shapes)
    order = value.masked_fill(~allowed, -torch.inf).topk(kept).indices
    assert (found == lists[order]).all()


@pytest.mark.parametrize("kind", ["classes", "chain"])
@pytest.mark.parametrize("limit", [(0, 0), (-1, 0)])
def test_an_inventory_that_allows_nothing_is_an_error(kind: str, limit: tuple[int, ...]) -> None:
    with pytest.raises(StackgenError, match="no list of 1 to 3 blocks"):
        head_of(kind, 2, 3).best(torch.randn(2, 8), 1, torch.tensor(limit))


@pytest.mark.parametrize("kind", ["classes", "chain"])
@pytest.mark.parametrize("counts", [[0, 0, 0, 0], [11, 0, 0, 0], [5, 5, 5, 5], [-1, 3, 0, 0]])
def test_a_list_that_cannot_be_has_no_probability(kind: str, counts: list[int]) -> None:
    with pytest.raises(StackgenError, match="1 to 10 blocks"):
        head_of(kind, 4, 10).log_probabilities(torch.randn(1, 8), torch.tensor([[[1, 0, 0, 0], counts]]))


def test_the_chain_s_best_list_of_a_large_world_beats_all_others_tried() -> None:
    head, features = head_of("chain", 7, 20), torch.randn(2, 8)
    found = head.best(features, 5)
    value = head.log_probabilities(features, found)
    assert (value.diff(dim=1) <= 0).all()
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, 4, (4000, 7))
    tried = torch.from_numpy(drawn[(drawn.sum(1) > 0) & (drawn.sum(1) <= 20)])
    near = (found[:, None] + torch.from_numpy(rng.integers(-1, 2, (500, 1, 7)))).flatten(0, 2).clamp(min=0)
    near = near[(near.sum(1) > 0) & (near.sum(1) <= 20)]
    for lists in (tried, near):
        assert (head.log_probabilities(features, lists.expand(2, -1, -1)).amax(1) <= value[:, 0] + 1e-5).all()


# The network.


def test_the_paper_s_network() -> None:
    """Ten channels at full size through thirty residual layers, max pooling, two fully connected layers."""
    network = BlockListNetwork(CNNConfig(), PAPER_WORLD)
    layers = [layer for layer in network.layers if isinstance(layer, Residual)]
    assert len(layers) == 30 and network.stem.out_channels == 10
    shapes: list[torch.Size] = []
    for part in (network.stem, layers[0], layers[-1], network.pool, network.hidden, network.out):
        part.register_forward_hook(lambda module, args, out: shapes.append(out.shape))
    network.best(torch.zeros(2, 64, 64), 1)
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


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> BlockListNetwork:
    """A network whose most likely class is the one that the picture's pixel count names."""

    def features(silhouettes: Tensor) -> Tensor:
        return -(torch.arange(1000) - silhouettes.sum((1, 2)).long()[:, None]).abs().float()

    network = BlockListNetwork(SMALL, PAPER_WORLD)
    network.out = ClassHead(1000, 4, 10)
    nn.init.eye_(network.out.weight)
    nn.init.zeros_(network.out.bias)
    monkeypatch.setattr(network, "features", features)
    return network


def test_predictions_are_the_lists_of_the_best_classes(known: BlockListNetwork) -> None:
    predictor = CNNPredictor(known, PAPER_WORLD)
    wanted = np.array([3, 500, 998] * 200)  # more than one batch
    pictures = np.zeros((600, 4096), bool)
    for picture, count in zip(pictures, wanted, strict=True):
        picture[:count] = True
    images = pictures.reshape(-1, 64, 64)
    lists = all_block_lists(4, 10)
    found = predictor.predict(images, top=3)
    assert found.shape == (600, 3, 4)
    assert (found[:, 0] == lists[wanted]).all()
    for row, first in zip(found[:3], wanted, strict=False):
        assert {tuple(c) for c in row} == {tuple(c) for c in lists[first - 1 : first + 2]}
    assert (predictor.predict(images[:2]) == found[:2, :1]).all()
    scores = predictor.log_probabilities(images, lists[[3, 4, 998]])
    assert scores.shape == (600, 3)
    assert (scores.argmax(1) == np.array([0, 1, 2] * 200)).all()  # 500 is nearer to 4 than to 998


@pytest.mark.parametrize("limit", [np.array([1, 1]), np.array([[1, 1, 1, 1]])])
def test_an_inventory_of_another_catalogue_is_an_error(limit: np.ndarray) -> None:
    with pytest.raises(StackgenError, match="one count for each of cube, rectangle"):
        CNNPredictor(BlockListNetwork(SMALL, PAPER_WORLD), PAPER_WORLD).predict(np.ones((1, 64, 64), bool), limit=limit)


# A fit.


@pytest.mark.parametrize("head", ["classes", "chain"])
def test_it_learns_and_every_form_of_it_predicts_alike(
    head: str, compact: Path, arrays: StackArrays, tmp_path: Path
) -> None:
    pl.seed_everything(0, verbose=False)
    config = CNNConfig(channels=8, layers=1, stem_stride=4, pool=8, hidden=32, head=head)  # type: ignore[arg-type]
    module = BlockListCNN(config, OptimizerConfig(learning_rate=1e-2, warmup=2))
    data = StackDataModule(compact, batch_size=16)
    trainer = trainer_for(tmp_path, max_epochs=30, enable_checkpointing=True)
    trainer.fit(module, data)
    images, counts = arrays.images(slice(32)), arrays.counts[:32]
    predictor = module.predictor()
    module.eval()
    assert (predictor.predict(images)[:, 0] == counts).all(axis=1).mean() > 0.9  # of its own training pictures
    limit = np.array([10, 0, 10, 10])
    assert (predictor.predict(images, limit=limit) <= limit).all()
    metrics = trainer_for(tmp_path).validate(module, data, verbose=False)[0]
    assert set(metrics) == {"validation/loss", "validation/exact", "validation/top3"}
    assert 0 <= metrics["validation/exact"] <= metrics["validation/top3"] <= 1
    trainer.save_checkpoint(tmp_path / "cnn.ckpt")
    export_checkpoint(tmp_path / "cnn.ckpt", tmp_path / "cnn.safetensors")
    for name in ("cnn.ckpt", "cnn.safetensors"):
        loaded = load_predictor(tmp_path / name)
        assert (loaded.predict(images, top=3) == predictor.predict(images, top=3)).all()


def test_metrics_are_shares_of_the_truth(known: BlockListNetwork) -> None:
    """Exact match is the most likely class, top 3 any of the three."""
    module = BlockListCNN(SMALL)
    module.model = known
    pictures = torch.zeros(4, 64, 64).flatten(1)
    for picture, count in zip(pictures, (10, 20, 30, 40), strict=True):
        picture[:count] = 1
    truth = torch.from_numpy(all_block_lists(4, 10))[[10, 21, 29, 300]]
    features = known.features(pictures.reshape(4, 64, 64))
    hits = module._hits(features, truth)
    assert hits[:, 0].tolist() == [True, False, False, False]
    assert hits.any(-1).tolist() == [True, True, True, False]
    assert module._loss(features, truth) > module._loss(features[:1], truth[:1]) > 0
