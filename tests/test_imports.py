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

CORE = ("stackgen.stack", "stackgen.geometry", "stackgen.protocols", "stackgen.files")
MAY_NOT_IMPORT = {
    "stackgen.stack": ("stackgen",),
    "stackgen.geometry": ("stackgen.sim", "stackgen.data", "stackgen.models", "stackgen.metrics", "stackgen.commands"),
    "stackgen.protocols": ("stackgen.sim", "stackgen.data", "stackgen.models", "stackgen.metrics"),
    "stackgen.sim": ("stackgen.data", "stackgen.models", "stackgen.metrics", "stackgen.baselines", "stackgen.api"),
    "stackgen.metrics": ("stackgen.sim", "stackgen.data", "stackgen.models", "stackgen.baselines"),
    "stackgen.evaluation": ("stackgen.sim", "stackgen.models", "stackgen.baselines"),
    "stackgen.data": ("stackgen.sim", "stackgen.models", "stackgen.metrics", "stackgen.baselines", "stackgen.api"),
    "stackgen.data.generation": ("stackgen.models", "stackgen.metrics", "stackgen.baselines", "stackgen.api"),
    "stackgen.models": ("stackgen.sim", "stackgen.baselines", "stackgen.api", "stackgen.evaluation"),
    "stackgen.baselines": ("stackgen.sim", "stackgen.api"),
    "stackgen.cli": ("stackgen",),
}
"""The most specific entry counts; whoever has none may import anything but the commands."""

RUNS_WITHOUT = {
    "import stackgen": ("numpy", "torch", "scipy"),
    "from stackgen.cli import usage; usage()": ("numpy", "torch", "jsonargparse", "rich"),
    "import stackgen.commands.sample, stackgen.weights": (
        "lightning",
        "pytorch_lightning",
        "webdataset",
        "wandb",
        "matplotlib.pyplot",
    ),
    "import stackgen.commands.check": ("lightning", "torch", "webdataset", "wandb", "matplotlib.pyplot"),
    "import stackgen.commands.lightning": ("pybullet",),
    "import stackgen.models.ddpm, stackgen.models.blocklist, stackgen.metrics": ("pybullet", "wandb", "cv2"),
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
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: imports are absolute here"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


FILES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: module_name(path))
def test_imports_point_one_way(path: Path) -> None:
    name = module_name(path)
    rules = [rule for rule in MAY_NOT_IMPORT if within(name, rule)]
    forbidden = MAY_NOT_IMPORT[max(rules, key=len)] if rules else ()
    if not within(name, "stackgen.commands"):
        forbidden = (*forbidden, "stackgen.commands")
    wrong = {target for target in imported(path) for package in forbidden if within(target, package)}
    assert not wrong, f"{name} must not import {sorted(wrong)}"


def test_the_table_of_verbs_needs_the_standard_library_only() -> None:
    outside = {name for name in imported(PACKAGE / "cli.py") if name.partition(".")[0] not in sys.stdlib_module_names}
    assert outside == set()


@pytest.mark.parametrize("code", RUNS_WITHOUT)
def test_nobody_loads_what_only_others_need(code: str) -> None:
    names = RUNS_WITHOUT[code]
    probe = f"import sys\n{code}\nprint([n for n in {names!r} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_every_package_that_is_imported_is_declared_and_the_other_way_round() -> None:
    distribution = {
        "cv2": "opencv-python-headless",
        "PIL": "pillow",
        "yaml": "pyyaml",
        "pytorch_lightning": "lightning",
        "ur_analytic_ik": "ur-analytic-ik",
        **dict.fromkeys(("rtde_control", "rtde_io", "rtde_receive"), "ur-rtde"),
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
