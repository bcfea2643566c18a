"""An installed package has every file that the code reads, and works far from the checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

import stackgen

setuptools = pytest.importorskip("setuptools", reason="asks the build backend")

ROOT = Path(__file__).parents[1]
FILES = {
    file.relative_to(ROOT)
    for file in (ROOT / "stackgen").rglob("*")
    if file.is_file() and "__pycache__" not in file.parts
}


@pytest.mark.parametrize("name", ["index.html", "studio.css"])
def test_the_committed_page_of_the_studio_is_that_of_its_source(name: str) -> None:
    assert (ROOT / "stackgen" / "assets" / "studio" / name).read_bytes() == (ROOT / "studio" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / "studio/node_modules").is_dir(), reason="needs Node: cd studio && npm ci")
def test_the_committed_script_of_the_studio_is_what_its_source_becomes(tmp_path: Path) -> None:
    subprocess.run(["node", "build.mjs", tmp_path], cwd=ROOT / "studio", check=True)
    assert (tmp_path / "studio.js").read_bytes() == (ROOT / "stackgen/assets/studio/studio.js").read_bytes()


def test_every_file_of_the_package_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    distribution = setuptools.Distribution({"script_name": "setup.py"})
    distribution.parse_config_files(["setup.cfg"])
    build = distribution.get_command_obj("build_py")
    build.ensure_finalized()
    installed = {Path(file).relative_to(build.build_lib) for file in build.get_outputs(include_bytecode=False)}
    assert installed == FILES


def test_the_package_knows_its_version() -> None:
    assert stackgen.__version__[0].isdigit() and "__version__" in dir(stackgen)


@pytest.mark.slow
def test_a_wheel_works_outside_the_checkout(tmp_path: Path) -> None:
    checkout, place = tmp_path / "checkout", tmp_path / "installed"
    for name in (*FILES, *map(Path, ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"))):
        (checkout / name).parent.mkdir(parents=True, exist_ok=True)  # a copy, since a build leaves folders behind
        shutil.copy(ROOT / name, checkout / name)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", tmp_path, checkout], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = {Path(name) for name in archive.namelist() if name.startswith("stackgen/")}
    assert held == FILES
    subprocess.run([*pip, "install", "--no-deps", "--target", place, wheel], check=True)

    def run(*arguments: str | Path) -> str:
        code = "import stackgen, sys; from stackgen.commands.cli import main; sys.stderr.write(stackgen.__file__); "
        done = subprocess.run(
            [sys.executable, "-c", f"{code}sys.exit(main())", *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(place), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0 and done.stderr.startswith(str(place)), done.stderr
        return done.stdout

    arch = ROOT / "examples/silhouettes/arch.png"
    run("sample", arch, "--one_shot", "--blocks", "cube=2,long_rectangle=1", "--num_samples", "1", "--out", "out")
    run("show", "out/stacks.json", "--out", "shown.png")
    run("sample", arch, "--num_samples", "1", "--out", "best")
    run("check", "best/stacks.json")
    if find_spec("pybullet"):
        run("build", "best/stacks.json")
    assert (tmp_path / "shown.html").stat().st_size > 1000
    assert json.loads(run("dataset", "verify", place / "stackgen/assets/testset-v1", "--json"))["sound"]
