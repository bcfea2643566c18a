"""Imports point one way, and nobody loads what only others need."""

from __future__ import annotations

import ast
import configparser
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "stackgen"

RUNS_WITHOUT = {
    "import stackgen": ("numpy", "torch", "scipy"),
    "from stackgen.commands.cli import usage; usage()": ("numpy", "torch", "jsonargparse", "rich"),
    "from contextlib import redirect_stdout as to; from io import StringIO; from stackgen.commands.cli import main\n"
    "with to(StringIO()): assert main(['sample', '--help']) == 0": ("numpy", "omegaconf", "rich", "stackgen.api"),
    "from stackgen.commands.cli import main; from tempfile import mkdtemp\n"
    "assert main(['sample', 'examples/silhouettes/arch.png', '--quiet', '--out', mkdtemp()]) == 0": (
        "scipy",
        "torch",
        "omegaconf",
        "matplotlib",
    ),
    "import stackgen.commands.sample_pictures, stackgen.models.weights": (
        "lightning",
        "pytorch_lightning",
        "webdataset",
        "wandb",
        "matplotlib.pyplot",
    ),
    "import stackgen.commands.check": ("lightning", "torch", "webdataset", "wandb", "matplotlib.pyplot"),
    "from stackgen.data import TESTSET, Dataset; Dataset.open(TESTSET).split('test')": (
        "lightning",
        "webdataset",
        "pybullet",
    ),
    "import stackgen.data.generation.generate": ("torch", "webdataset"),
    "import stackgen.baselines, stackgen.sampling.methods, stackgen.sampling.verified": ("torch", "torchmetrics"),
    "import stackgen.commands.fit, stackgen.training.callbacks, stackgen.models.diffusion.module\n"
    "import stackgen.models.block_list.network, stackgen.evaluation.metrics": (
        "pybullet",
        "mujoco",
        "stackgen.sim.simulator",
        "wandb",
        "cv2",
    ),
}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path: Path, top_level_only: bool = False) -> set[str]:
    """Names of the modules a file imports, `from a import b` as a.b."""
    tree = ast.parse(path.read_text())
    nodes = list(ast.walk(tree))
    if top_level_only:
        nodes = list(tree.body)
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "require":
            found |= {str(argument.value) for argument in node.args[:1] if isinstance(argument, ast.Constant)}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: imports are absolute here"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


FILES = sorted(PACKAGE.rglob("*.py"))


def test_the_table_of_verbs_needs_the_standard_library_only() -> None:
    outside = {
        name.rpartition(".")[0]
        for file in ("commands/cli.py", "errors.py")
        for name in imported(PACKAGE / file)
        if name.partition(".")[0] not in sys.stdlib_module_names
    }
    assert outside == {"stackgen.errors"}


@pytest.mark.parametrize("code", RUNS_WITHOUT)
def test_nobody_loads_what_only_others_need(code: str) -> None:
    names = RUNS_WITHOUT[code]
    probe = f"import sys\n{code}\nprint([n for n in {names!r} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_every_package_that_is_imported_is_declared_and_the_other_way_round() -> None:
    distribution = {
        "cv2": "opencv-python-headless",
        "markdown_it": "markdown-it-py",
        "PIL": "pillow",
        "yaml": "pyyaml",
        "lazy_loader": "lazy-loader",
        "pytorch_lightning": "lightning",
        "pinocchio": "pin",
        **dict.fromkeys(("rtde_control", "rtde_io", "rtde_receive", "dashboard_client"), "ur-rtde"),
    }
    used = {name.partition(".")[0] for path in FILES for name in imported(path)}
    used = {distribution.get(name, name) for name in used if name not in sys.stdlib_module_names} - {"stackgen"}
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    extras = "".join(text for extra, text in setup["options.extras_require"].items() if extra != "dev")
    lines = [line.strip() for line in (setup["options"]["install_requires"] + extras).splitlines()]
    names = {line.split("[")[0] for line in lines if line and not line.startswith("#")}
    declared = {name.split(">")[0].split("=")[0].split(";")[0].strip() for name in names}
    through_others = {"wandb", "tensorboard", "example-robot-data"}  # by Lightning's loggers; files that are read
    assert used - declared == set()
    assert declared - used - through_others == set()
