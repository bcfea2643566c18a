"""A dataset is the same wherever it lies, and a line says why where it cannot be read."""

from __future__ import annotations

import importlib.util
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import fsspec  # type: ignore[import-untyped]
import numpy as np
import pytest

from stackgen.data import sources
from stackgen.data.arrays import StackArrays
from stackgen.data.compact import save_npz
from stackgen.data.datamodule import StackDataModule
from stackgen.data.dataset import Dataset
from stackgen.data.loading.streaming import TrainingStream
from stackgen.data.sources import read_bytes
from stackgen.errors import StackgenError


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ask again at once."""
    monkeypatch.setattr(sources, "WAITS", (0.0, 0.0))


class Handler(SimpleHTTPRequestHandler):
    """Serves a folder; what `cut` names is cut short as often as it says."""

    cut: ClassVar[dict[str, int]] = {}

    def do_GET(self) -> None:
        name = self.path.rpartition("/")[2]
        if self.cut.get(name, 0) > 0:
            self.cut[name] -= 1
            content = Path(self.translate_path(self.path)).read_bytes()[:1000]
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)
        else:
            super().do_GET()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def served(dataset: Path) -> Iterator[str]:
    """The URL of a web server that has the dataset."""
    Handler.cut = {}
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(dataset)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def place(request: pytest.FixtureRequest, dataset: Path) -> Iterator[str]:
    """The dataset in a place of the kind that the test names."""
    if request.param == "file":
        yield f"file://{dataset}"
    elif request.param == "pipe":
        yield f"pipe:cat {dataset}/{{file}}"
    elif request.param == "http":
        yield request.getfixturevalue("served")
    else:
        memory = fsspec.filesystem("memory")
        memory.put(str(dataset), "/place", recursive=True)
        yield "memory://place"
        memory.rm("/place", recursive=True)


def same(a: StackArrays, b: StackArrays) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in ("shapes", "poses", "silhouettes", "template")
    )


@pytest.mark.parametrize("place", ["file", "memory", "http", "pipe"], indirect=True)
def test_a_dataset_is_the_same_wherever_it_lies(place: str, dataset: Path, splits: dict[str, StackArrays]) -> None:
    found = Dataset.open(place)
    assert found.manifest == Dataset.open(dataset).manifest
    assert found.splits == tuple(splits) and all(same(found.split(name), splits[name]) for name in splits)


@pytest.mark.parametrize("place", ["memory", "http", "pipe"], indirect=True)
@pytest.mark.parametrize("workers", [0, 2])
def test_it_streams_from_anywhere(place: str, dataset: Path, workers: int) -> None:
    here, there = (
        StackDataModule(path, batch_size=8, mode="stream", num_workers=workers, test_path=path)
        for path in (dataset, place)
    )
    for name in ("train_dataloader", "val_dataloader", "test_dataloader"):
        expected, got = ([b["template"].tolist() for b in getattr(data, name)()] for data in (here, there))
        assert expected == got
    assert there.manifest == here.manifest == there.test_dataset.manifest
    assert all(map(np.array_equal, here.pose_statistics(), there.pose_statistics()))


def test_a_compact_file_may_lie_elsewhere_too(dataset: Path, splits: dict[str, StackArrays], tmp_path: Path) -> None:
    save_npz(tmp_path / "d.npz", splits, Dataset.open(dataset).manifest)
    for path in (f"file://{tmp_path}/d.npz", f"pipe:cat {tmp_path}/d.npz"):
        data = StackDataModule(path, batch_size=8)
        data.setup("fit")
        assert data.is_cached("train") and same(data.split("train"), splits["train"])


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("http://127.0.0.1:9/data", "127.0.0.1:9"),
        ("memory://nowhere", "there is no file memory://nowhere/dataset.json"),
        ("file:///nowhere.npz", "no file|No such file"),
        ("strange://host/data", "strange"),
        ("pipe:cat /nowhere/{file}", r"`cat /nowhere/dataset.json` ended with exit code 1"),
        ("pipe:echo {file}", "not JSON"),
        ("pipe:true", "not a compact stackgen dataset"),
        ("s3://bucket/data", "s3"),
    ],
)
def test_what_cannot_be_read_is_one_line_that_names_it(path: str, reason: str) -> None:
    if path.startswith("s3:") and importlib.util.find_spec("s3fs"):
        pytest.skip("would ask the network")
    with pytest.raises(StackgenError, match=reason) as caught:
        StackDataModule(path).setup("fit")
    assert "\n" not in str(caught.value) and path.removeprefix("pipe:").partition("{")[0].rstrip("/") in str(
        caught.value
    )


def test_what_was_cut_on_the_way_is_asked_for_again(served: str, splits: dict[str, StackArrays]) -> None:
    Handler.cut = {"train-000000.tar": 2}
    assert same(Dataset.open(served).split("train"), splits["train"])
    assert Handler.cut == {"train-000000.tar": 0}


def test_a_shard_that_stays_cut_is_named(served: str) -> None:
    Handler.cut = {"train-000000.tar": 99}
    with pytest.raises(StackgenError, match=rf"{served}/train-000000.tar is damaged: cut short.*fetch it again"):
        Dataset.open(served).split("train")
    with pytest.warns(UserWarning, match="train-000000") as caught:
        batches = list(TrainingStream(Dataset.open(served), 8))
    assert len(batches) == 71 // 8
    lines = [str(warning.message) for warning in caught]
    assert len(lines) == 2 and "train-000000.tar is damaged: cut short" in lines[0]
    assert lines[0].endswith("fetch it again; its 41 samples are skipped")


@pytest.mark.parametrize("name", ["x; touch hacked", "../other.tar", "/etc/passwd", "a b", "$(id)", "x|y", ""])
def test_a_manifest_cannot_make_a_command_or_leave_its_folder(dataset: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(dataset, tmp_path / "d")
    path = tmp_path / "d" / "dataset.json"
    path.write_text(path.read_text().replace('"train-000000.tar"', f'"{name}"'))
    for root in (str(tmp_path / "d"), f"pipe:cat {tmp_path}/d/{{file}}"):
        with pytest.raises(StackgenError, match="not a plain file name"):
            Dataset.open(root).split("train")
    assert not Path("hacked").exists()


def test_a_file_system_s_own_errors_become_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(url: str) -> None:
        raise RuntimeError("token\nexpired")

    monkeypatch.setattr("fsspec.url_to_fs", refuse)
    with pytest.raises(StackgenError, match="s3://bucket/x cannot be read: token expired"):
        read_bytes("s3://bucket/x")
