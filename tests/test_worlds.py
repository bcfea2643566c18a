"""Other worlds by configuration: grid and shapes from YAML, designs with rows of several heights, the whole path."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from stackgen.data.dataset import Dataset
from stackgen.data.generation.designs import Design, DesignSettings, cells_wide, draw_design, realize
from stackgen.data.generation.recipes import template_samples
from stackgen.data.generation.settings import GenerateSettings
from stackgen.data.manifest import Manifest
from stackgen.data.shards import Sample, write_shard
from stackgen.errors import StackgenError
from stackgen.geometry import mirror, silhouette
from stackgen.models.weights import last_checkpoint
from stackgen.sim.physics import Physics
from stackgen.sim.simulator import Simulator
from stackgen.stack import Stack
from stackgen.vision.drawings import grid_offset
from stackgen.viz.render import save_image
from stackgen.world import PAPER_GRID, Catalogue, Grid, World
from tests.conftest import Cli
from tests.test_configs import settings_of

WIDE = Path(__file__).parents[1] / "configs" / "worlds" / "wide" / "generate.yaml"
PLANK = {"name": "plank", "width": 2, "height": 0.5}


@pytest.fixture(scope="module")
def wide() -> GenerateSettings:
    """The shipped example."""
    return settings_of(WIDE)


# The configuration.


def test_the_example_is_what_it_says(wide: GenerateSettings) -> None:
    assert (wide.grid.width, wide.grid.height, wide.max_blocks, len(wide.catalogue)) == (6, 5, 20, 7)
    sizes = {shape.name: shape.size for shape in wide.catalogue}
    assert sizes["beam"] == (4, 1, 1) and sizes["plank"] == (2, 1, 0.5)
    assert not wide.catalogue[wide.catalogue.index("ramp")].is_box
    assert wide.physics.friction != Physics().friction


@pytest.mark.parametrize("options", [["--config", WIDE], ["--name", "x", "--stacks", 5]], ids=["wide", "paper"])
def test_the_printed_configuration_is_read_back_as_it_was(cli: Cli, tmp_path: Path, options: list[Any]) -> None:
    printed = cli("generate", *options, "--print_config")
    assert printed.code == 0 and not printed.err
    content = yaml.safe_load(printed.out)
    again = tmp_path / "again.yaml"
    again.write_text(printed.out)
    assert cli("generate", "--config", again, "--print_config").out == printed.out
    wanted = settings_of(WIDE) if options[0] == "--config" else GenerateSettings("x", 5)
    assert settings_of(again) == wanted
    assert Catalogue.from_json(content["catalogue"]) == wanted.catalogue


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"name": "a", "outline": [[-1, -1], [1, -1], [0, -0.5], [1, 1], [-1, 1]]}, ["'a'", "convex"]),
        ({"name": "a", "outline": [[-1, -1], [-1, 1], [1, 1], [1, -1]]}, ["'a'", "clockwise", "reverse"]),
        ({"name": "a", "outline": [[-1, -1], [0, 0], [1, 1]]}, ["'a'", "no area"]),
        ({"name": "a", "outline": [[0, 0], [1, 0], [1, 1], [0, 1]]}, ["'a'", "centred", "subtract (0.5, 0.5)"]),
        ({"name": "a", "outline": 3}, ["'a'", "outline"]),
        ({"name": "a", "width": 0}, ["'a'", "positive"]),
        ({"name": "a", "width": "wide"}, ["'a'", "numbers"]),
        ({"name": "a b", "width": 1}, ["name", "'a b'"]),
        ({"name": "a", "hight": 2}, ["{name, width, height, depth}", "hight"]),
        ({"name": "a", "width": 7}, ["'a'", "larger than the 6 x 5 grid"]),
        ({"name": "a", "outline": [[0, -0.5], [0.5, 0], [0, 0.5], [-0.5, 0]]}, ["'a'", "bottom"]),
        ({"name": "a", "outline": [[-1, -0.5], [1, -0.5], [0, 0.5]]}, ["'a'", "top_row_only"]),
        ({"name": "a", "width": 3, "height": 0.25}, ["'a'", "fall_height to 0.125"]),
        ({"name": "a", "width": 4, "height": 2}, ["'a'", "minimum_fill to 3"]),
        ("cube", ["distinct", "cube"]),
        ("ball", ["'ball'", "cube, rectangle"]),
        (7, ["a shape is", "7"]),
    ],
)
def test_a_bad_catalogue_is_one_line(cli: Cli, tmp_path: Path, entry: Any, words: list[str]) -> None:
    content = yaml.safe_load(WIDE.read_text())
    content["catalogue"].append(entry)
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(content))
    answer = cli("generate", "--config", path, "--out", tmp_path / "out")
    assert answer.code == 2 and not (tmp_path / "out").exists()
    for word in words:
        assert word in answer.line, answer.line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--grid.width", 6], ["6 x 4 cells", "image_size to 96 or pixels_per_cell to 10"]),
        (["--grid.image_size", 70], ["multiple of 8"]),
        (["--grid.height", 0], ["height", "at least 1"]),
        (["--grid.pixels_per_cell", -1], ["pixels_per_cell", "positive"]),
        (["--grid.ground_margin", 64], ["ground_margin"]),
        (["--template.minimum_fill", 5], ["minimum_fill", "1..4"]),
        (["--template.top_row_only", "[ball]"], ["ball", "not in the catalogue"]),
        (["--template.top_row_only", "[cube, rectangle, long_rectangle, triangle]"], ["below the top row"]),
        (["--catalogue", "cube"], ["list of shapes", "'cube'"]),
        (["--catalogue", "[]"], ["at least one shape"]),
    ],
)
def test_a_bad_grid_or_template_is_one_line(cli: Cli, tmp_path: Path, options: list[Any], words: list[str]) -> None:
    answer = cli("generate", "--name", "x", "--stacks", 5, "--out", tmp_path / "out", *options)
    assert answer.code == 2
    for word in words:
        assert word in answer.line, answer.line


# The grid.


def test_whole_numbers_of_a_file_may_have_a_point() -> None:
    assert repr(Grid(4.0, 4, 64.0)) == repr(Grid(4, 4, 64))  # type: ignore[arg-type]


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4, 4), (6, 5), (5, 7), (12, 3)])
def test_the_size_that_an_error_names_would_do(width: int, height: int) -> None:
    with pytest.raises(StackgenError) as caught:
        Grid(width, height, image_size=8).require_room()
    words = str(caught.value).split()
    Grid(width, height, int(words[words.index("image_size") + 2])).require_room()
    if width > 4:  # at 8 pixels nothing would do
        with pytest.raises(StackgenError) as caught:
            Grid(width, height).require_room()
        Grid(width, height, pixels_per_cell=int(str(caught.value).split()[-1])).require_room()


@pytest.mark.parametrize("grid", [PAPER_GRID, Grid(6, 5, 96, 14, 6), Grid(5, 4, 80, 14, 4), Grid(7, 4, 64, 8, 2)])
def test_what_stands_on_the_cells_of_a_grid_of_any_width_stays_there(grid: Grid) -> None:
    x = -grid.width / 2 + 0.5 + np.array([0, 1, 1, 2])
    poses = [[a, 0, z, 0, 0, 0] for a, z in zip(x, (0.5, 0.5, 1.5, 0.5), strict=True)]
    tower = Stack(np.array([0, 0, 0, 0]), np.array(poses))
    on_cells = silhouette(tower, grid)
    assert grid_offset(on_cells, grid) == 0
    shift = round(grid.pixels_per_cell / 2) - 1
    assert grid_offset(np.roll(on_cells, shift, axis=1), grid) == -shift


# Designs.


def designs(settings: GenerateSettings, count: int = 200) -> list[Design]:
    rng = np.random.default_rng(0)
    return [draw_design(rng, settings.world, settings.template) for _ in range(count)]


def test_rows_are_of_one_height_and_fill_the_grid(wide: GenerateSettings) -> None:
    for template in designs(wide):
        heights = [{wide.catalogue[s].size[2] for s, _ in row} for row in template.rows]
        assert all(len(row) == 1 for row in heights)
        assert sum(row.pop() for row in heights) == wide.grid.height
        for row in template.rows:
            cells = [c for s, left in row for c in range(left, left + cells_wide(wide.catalogue[s]))]
            assert cells == sorted(set(cells)) and 0 <= cells[0] and cells[-1] < 6 and len(cells) >= 4
        triangle = wide.catalogue.index("triangle")
        assert not any(s == triangle for row in template.rows[:-1] for s, _ in row)
    assert any(len(template.rows) > 5 for template in designs(wide))


def test_every_shape_is_drawn_and_nothing_is_cut_off_in_the_picture(wide: GenerateSettings) -> None:
    rng = np.random.default_rng(1)
    seen = np.zeros(7, int)
    still = DesignSettings(4, 0.0, ("triangle",))
    for template in designs(wide, 60):
        stack = realize(template, rng, wide.world, wide.template)
        seen += stack.counts
        picture = silhouette(stack, wide.grid)
        assert not picture[:, [0, -1]].any() and not picture[[0, -1]].any()
        exact = silhouette(realize(template, rng, wide.world, still), wide.grid)
        area = sum(wide.catalogue[s].area for s in stack.shapes)
        assert exact.sum() / wide.grid.pixels_per_cell**2 == pytest.approx(area, abs=0.15 * len(stack))
    assert (seen > 0).all()


def test_a_mirrored_design_is_the_mirror_image(wide: GenerateSettings) -> None:
    still = DesignSettings(4, 0.0, ("triangle",))
    rng = np.random.default_rng(0)
    for template in designs(wide, 30):
        stack = realize(template, rng, wide.world, still)
        other = realize(template.mirrored(wide.world), rng, wide.world, still)
        a, b = (sorted(zip(s.shapes.tolist(), s.poses.tolist(), strict=True)) for s in (mirror(stack), other))
        assert a == b


def test_a_shape_takes_up_whole_cells_and_stands_in_their_middle() -> None:
    catalogue = Catalogue.from_config(["cube", {"name": "coin", "width": 1.4}])
    row = Design((((1, 0), (0, 2)),))
    stack = realize(row, np.random.default_rng(0), World(catalogue, PAPER_GRID, 10), DesignSettings(displacement=0))
    assert stack.poses[:, 0].tolist() == [-1, 0.5]
    assert cells_wide(catalogue[1]) == 2


def test_stacks_of_the_example_settle(wide: GenerateSettings) -> None:
    with Simulator(wide.physics) as simulator:
        found: list[Sample] = []
        number = 0
        while len(found) < 3:
            found += template_samples(wide, number, frozenset(), simulator)[:2]
            number += 1
    for sample in found:
        assert sample.silhouette.shape == (96, 96) and len(sample.shapes) <= 20
        assert (sample.poses[:, 2] > 0.2).all()


# The path: a dataset of designs, so that nothing waits for the simulator.


@pytest.fixture(scope="module")
def dataset(wide: GenerateSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wide")
    rng = np.random.default_rng(0)
    entries = []
    for number, (split, size) in enumerate((("train", 24), ("validation", 4), ("test", 2))):
        samples: list[Sample] = []
        while len(samples) < size:
            design = draw_design(rng, wide.world, wide.template)
            stack = realize(design, rng, wide.world, wide.template)
            if len(stack) <= wide.max_blocks:
                meta = {"template": 100 * number + len(samples), "layout": design.key, "removed": []}
                picture = silhouette(stack, wide.grid)
                shapes, poses = stack.shapes.astype(np.uint8), stack.poses.astype(np.float32)
                samples.append(Sample(f"{number}{len(samples):03d}", shapes, poses, picture, meta))
        entries.append(write_shard(folder / f"{split}-{number:06d}.tar", samples))
    physics = wide.physics.to_json()
    Manifest("wide", 0, wide.world, physics, {}, tuple(entries)).save(folder)
    return folder


def fit_briefly(cli: Cli, name: str, folder: Path, data: Path) -> Path:
    """Two steps of one of the example's configurations, at a small size."""
    content = yaml.safe_load(WIDE.with_name(f"{name}.yaml").read_text())
    parts = content["model"]["init_args"]
    if name == "ddpm":
        parts["denoiser"] |= {"width": 16, "layers": 1, "heads": 2, "feedforward": 32, "memory_layers": 1}
        parts["schedule"]["steps"] = 5
    else:
        parts["cnn"] |= {"channels": 4, "layers": 1, "hidden": 16}
    content["trainer"] |= {
        "default_root_dir": str(folder), "max_steps": 2, "enable_progress_bar": False, "enable_model_summary": False,
        "callbacks": [],
    }  # fmt: skip
    content["data"] |= {"path": str(data), "batch_size": 8}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content))
    answer = cli("fit", "--config", path)
    assert answer.code == 0, answer.err
    weights = folder / f"{name}.safetensors"
    assert cli("export", last_checkpoint(folder / content["name"]), "--out", weights).code == 0
    return weights


def test_a_world_goes_the_whole_path(
    cli: Cli, wide: GenerateSettings, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "disabled")
    monkeypatch.chdir(tmp_path)
    sampler, predictor = (fit_briefly(cli, name, tmp_path, dataset) for name in ("ddpm", "blocklist"))
    card = json.loads(sampler.with_suffix(".json").read_text())
    assert Catalogue.from_json(card["catalogue"]) == wide.catalogue and Grid(**card["grid"]) == wide.grid
    assert card["max_blocks"] == 20 and card["dataset"]["physics"]["friction"] == 0.6

    weights = ["--weights", sampler, "--block_list_weights", predictor]
    answer = cli("test", *weights, "--test_set", dataset, "--num_samples", 1)
    assert answer.code == 0, answer.err
    (report,) = tmp_path.glob("runs/*/test_*/metrics.json")
    rows = json.loads(report.read_text())["rows"]
    assert {row["physics"]["friction"] for row in rows} == {0.6} and rows[-1]["scenes"] == 2
    assert rows[1]["block_lists"]["exact_match"] is not None
    assert rows[1]["block_lists"]["feasible"] is None  # rows of several heights
    refused = cli("test", *weights)  # the paper's test set
    assert refused.code == 2 and "another catalogue and grid" in refused.line

    stack = next(Dataset.open(dataset).samples("test"))
    save_image("scene.png", stack.silhouette)
    answer = cli(
        "sample", "scene.png", "--weights", sampler, "--block_list_weights", predictor, "--num_samples", 1, "--out", "o"
    )
    assert answer.code == 0, answer.err
    content = json.loads(Path("o/stacks.json").read_text())
    assert [shape["name"] for shape in content["catalogue"]] == list(wide.catalogue.names)
    assert content["grid"]["width"] == 6 and content["physics"]["fall_height"] == 0.25
    assert cli("check", "o/stacks.json", "--out", "checked.json", "--physics.density", 700).code in (0, 1)
    physics = json.loads(Path("checked.json").read_text())["physics"]
    assert (physics["friction"], physics["fall_height"], physics["density"]) == (0.6, 0.25, 700)
    assert cli("show", "o/stacks.json", "--out", "o/shown.png").code == 0
    assert Path("o/shown.png").exists() and Path("o/shown.html").exists()


def test_a_network_of_another_picture_size_is_one_line(cli: Cli, dataset: Path, tmp_path: Path) -> None:
    config = WIDE.parents[2] / "model" / "ddpm-small.yaml"
    answer = cli("fit", "--config", config, "--data.path", dataset, "--trainer.default_root_dir", tmp_path)
    assert answer.code == 2 and "96 pixels" in answer.err.splitlines()[-1]


@pytest.mark.slow
def test_the_example_generates(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "data"
    options = ["--stacks", 12, "--templates_per_shard", 2, "--workers", 1, "--max_removals", 1]
    answer = cli("generate", "--config", WIDE, "--out", out, *options)
    assert answer.code == 0, answer.err
    assert Dataset.open(out).manifest.world.catalogue == settings_of(WIDE).catalogue
