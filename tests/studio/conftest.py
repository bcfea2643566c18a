"""A studio in this process: its work is done at once, without other processes."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi")

from fastapi.testclient import TestClient
from pydantic import BaseModel

from stackgen.errors import StackgenError
from stackgen.studio.gallery import Gallery
from stackgen.studio.server import make_app
from stackgen.studio.work.tasks import TASKS
from stackgen.studio.workers import Refused, Workers


class Inline(Workers):
    """Workers without processes."""

    def open(self) -> None:
        """Nothing is to be started."""

    async def work(self, client: str, task: str, request: BaseModel) -> AsyncGenerator[bytes, None]:
        """Do the work here."""
        messages: list[bytes] = []
        try:
            TASKS[task](request, lambda message: messages.append(json.dumps(message, allow_nan=False).encode()))
        except StackgenError as error:
            raise Refused(str(error)) from error
        for message in messages:
            yield message


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the gallery."""
    return tmp_path_factory.mktemp("results")


@pytest.fixture(scope="module")
def studio(results: Path) -> Iterator[TestClient]:
    """A client of a studio."""
    with TestClient(make_app(Inline(1), Gallery(results)), base_url="http://127.0.0.1:8011") as client:
        yield client
