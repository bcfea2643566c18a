"""An installed package has every file that the code reads."""

from __future__ import annotations

from pathlib import Path

import pytest

setuptools = pytest.importorskip("setuptools", reason="asks the build backend")

ROOT = Path(__file__).parents[1]


def test_every_file_of_the_package_is_in_the_wheel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    distribution = setuptools.Distribution({"script_name": "setup.py"})
    distribution.parse_config_files(["setup.cfg"])
    build = distribution.get_command_obj("build_py")
    build.ensure_finalized()
    installed = {Path(file).relative_to(build.build_lib) for file in build.get_outputs(include_bytecode=False)}
    files = {file.relative_to(ROOT) for file in (ROOT / "stackgen").rglob("*") if file.is_file()}
    assert installed == {file for file in files if "__pycache__" not in file.parts}
