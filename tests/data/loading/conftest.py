"""What tests of streams share."""

from __future__ import annotations

import pytest

from stackgen.data.loading import passes


@pytest.fixture
def small_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """A window to suit the data."""
    monkeypatch.setattr(passes, "WINDOW", 16)
