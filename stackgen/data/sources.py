"""Where a dataset lies: in a folder, behind a URL, or behind a command that prints a file.

- a local path;
- a URL that fsspec knows, `s3://bucket/data/paper` or `https://host/data/paper`, below which the files
  have the names they have in a folder;
- `pipe:COMMAND`, a shell command whose output is the file, as webdataset runs it; `{file}` in it stands
  for a file's name, as in `pipe:ssh host cat data/paper/{file}`.

Everybody else opens a :class:`stackgen.data.dataset.Dataset`.
"""

from __future__ import annotations

import hashlib
import re
import time
from pathlib import Path

from stackgen.data.manifest import ShardEntry
from stackgen.data.shards import compression_of
from stackgen.errors import MALFORMED, StackgenError
from stackgen.io.files import read_bytes as read_file

PIPE = "pipe:"
FILE_NAME = "{file}"
"""Stands for the name of a file in a command."""

WAITS = (0.2, 1.0)
"""Pauses before a file that could not be fetched from afar is asked for again [s]."""

_PLAIN_NAME = re.compile(r"\w[\w.-]*")  # nothing that a shell, a URL or a path would read as more than a name


def is_remote(path: str) -> bool:
    """Tell whether a path is a URL or a command.

    >>> is_remote("data/paper"), is_remote("s3://bucket/data"), is_remote("pipe:cat data/{file}")
    (False, True, True)
    """
    return path.startswith(PIPE) or "://" in path


def is_folder(path: str) -> bool:
    """Tell whether a path stands for a manifest and shards; otherwise it is one compact file.

    >>> is_folder("https://host/data"), is_folder("https://host/data.npz"), is_folder("pipe:cat data.npz")
    (True, False, False)
    """
    if not is_remote(path):
        return Path(path).is_dir()
    return FILE_NAME in path if path.startswith(PIPE) else not path.endswith(".npz")


def locate(root: str, name: str) -> str:
    """Say where a file of the dataset at `root` lies.

    Raises:
        StackgenError: If `name` is not the plain name of a file.

    >>> locate("s3://bucket/data/", "train-000001.tar"), locate("pipe:ssh host cat {file}", "dataset.json")
    ('s3://bucket/data/train-000001.tar', 'pipe:ssh host cat dataset.json')
    """
    if not _PLAIN_NAME.fullmatch(name):
        raise StackgenError(f"dataset {root}: its manifest names a file {name!r}, which is not a plain file name")
    if root.startswith(PIPE):
        return root.replace(FILE_NAME, name)
    return f"{root.rstrip('/')}/{name}" if is_remote(root) else str(Path(root) / name)


def read_bytes(path: str) -> bytes:
    """Read a whole file from wherever it lies.

    Raises:
        StackgenError: If it cannot be read; one line.
    """
    try:
        if path.startswith(PIPE):
            return _output(path)
        return _fetch(path) if is_remote(path) else read_file(path)
    except FileNotFoundError as error:
        raise StackgenError(f"there is no file {path}") from error
    except StackgenError:
        raise
    except Exception as error:  # every file system of fsspec has errors of its own
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise StackgenError(f"{path} cannot be read: {reason}") from error


class Shard:
    """One shard of a dataset, wherever that lies.

    Args:
        root: Path of the dataset.
        entry: What the manifest says of the shard.

    Raises:
        StackgenError: If the manifest's entry is not complete.
    """

    def __init__(self, root: str, entry: ShardEntry) -> None:
        try:
            self.name, self.sha256, self.samples = str(entry["file"]), str(entry["sha256"]), int(entry["samples"])
        except MALFORMED as error:
            raise StackgenError(f"dataset {root}: dataset.json is damaged: shard {entry!r:.80}") from error
        self.path = locate(root, self.name)

    def read(self) -> bytes:
        """Read its bytes, if they are those that were written; from afar they are asked for up to three times.

        Raises:
            StackgenError: If it is missing, cut short or altered; the message names it.
        """
        for wait in WAITS if is_remote(self.path) else ():
            try:
                return self._read_once()
            except StackgenError:
                time.sleep(wait)
        return self._read_once()

    def _read_once(self) -> bytes:
        try:
            content = read_bytes(self.path)
        except StackgenError as error:
            raise StackgenError(f"shard {self.name} is missing or damaged: {error}") from error
        if compressed := compression_of(content):
            raise StackgenError(f"shard {self.path} is compressed with {compressed}, and a shard is a plain tar")
        if hashlib.sha256(content).hexdigest() != self.sha256:
            cure = "fetch it again" if is_remote(self.path) else "`stackgen dataset repair` makes it again"
            why = "cut short or altered, its checksum is not the one in dataset.json"
            raise StackgenError(f"shard {self.path} is damaged: {why}; {cure}")
        return content


def _fetch(url: str) -> bytes:
    import fsspec  # type: ignore[import-untyped]  # only where something lies elsewhere

    # A file system for every call: those that talk over a network do not survive a fork.
    files, path = fsspec.url_to_fs(url)
    return files.cat_file(path)


def _output(url: str) -> bytes:
    import webdataset  # only where something lies elsewhere

    command = webdataset.gopen(url)
    try:
        with command:
            return command.read()
    except OSError as error:
        raise StackgenError(f"`{url.removeprefix(PIPE)}` ended with exit code {command.status}") from error
