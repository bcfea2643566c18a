"""The local pages in a real browser: they show what was logged, and no request leaves the machine."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from PIL import Image

from stackgen.training.sweeps.coordinator import run_sweep
from tests.conftest import CHILD, Cli
from tests.training.sweeps.test_coordinator import PROGRAM, sweep_of
from tests.training.test_loggers import CURVES, TINY

playwright = pytest.importorskip("playwright.sync_api", reason="drives the browser: pip install playwright")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PATIENCE = 120_000  # [ms] on a busy machine

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, chromium-browser or google-chrome on the PATH"),
]


@contextmanager
def serving(program: str, *options: object) -> Iterator[str]:
    """The address of a server of this environment, once it answers; it ends with the block."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [Path(sys.executable).with_name(program), *options, "--host", "127.0.0.1", "--port", port]
    server = subprocess.Popen(
        [str(word) for word in command], env=CHILD, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        until = time.monotonic() + PATIENCE / 1000
        while True:
            assert server.poll() is None and time.monotonic() < until, f"{program} does not answer"
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                time.sleep(0.1)
        yield f"http://127.0.0.1:{port}/"
    finally:
        server.terminate()
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


class Browser:
    """A page of Chromium that remembers every request and every error."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.addresses: list[str] = []
        self.errors: list[str] = []
        page.set_default_timeout(PATIENCE)
        page.on("request", lambda request: self.addresses.append(request.url))
        page.on("websocket", lambda websocket: self.addresses.append(websocket.url))
        page.on("pageerror", lambda error: self.errors.append(str(error)))

    def wait_for(self, *texts: str) -> None:
        """Until all of them stand on the page, however it breaks its lines."""
        told = "texts => texts.every(t => document.body.innerText.replace(/\\s/g, '').includes(t))"
        self.page.wait_for_function(told, arg=["".join(text.split()) for text in texts])

    def assert_at_home(self) -> None:
        """Nothing was asked of any other machine, and nothing broke."""
        hosts = {urlsplit(address).hostname for address in self.addresses if not address.startswith(("data:", "blob:"))}
        assert hosts == {"127.0.0.1"}
        assert self.errors == []


@pytest.fixture
def browser() -> Iterator[Browser]:
    """An empty page, high enough that nothing waits to be scrolled to."""
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"], timeout=PATIENCE)
        try:
            yield Browser(chromium.new_page(viewport={"width": 1400, "height": 4000}))
        finally:
            chromium.close()


@pytest.fixture
def seen_run(cli: Cli, towers_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a short training with TensorBoard's events."""
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(TINY.format(data=towers_dataset))
    answer = cli("fit", "--config", "tiny.yaml", "--dashboard", "tensorboard")
    assert answer.code == 0, answer.err
    return tmp_path / "runs"


def test_tensorboard_shows_curves_pictures_and_the_configuration(seen_run: Path, browser: Browser) -> None:
    with serving("tensorboard", "--logdir", seen_run) as address:
        for group in ("train", "validation", "sample"):
            names = {name for name in CURVES if name.startswith(f"{group}/")}
            browser.page.goto(f"{address}?tagFilter=^{group}/#timeseries")
            browser.wait_for("seen/version_0", *names)
            browser.page.wait_for_function(f"document.querySelectorAll('line-chart').length >= {len(names)}")
        browser.page.goto(f"{address}#images")
        picture = browser.page.locator("img[src*=individualImage]").first
        picture.wait_for()
        size = picture.evaluate("i => i.decode().then(() => [i.naturalWidth, i.naturalHeight])")
        with Image.open(max(seen_run.glob("seen/version_0/pictures/sample/scenes/*.png"))) as drawn:
            assert tuple(size) == drawn.size
        browser.page.goto(f"{address}#text")
        browser.page.get_by_text("width: 32").first.wait_for()
        browser.page.get_by_text("sha256").first.wait_for()
    browser.assert_at_home()


def test_the_optuna_dashboard_opens_on_the_journal(tmp_path: Path, browser: Browser) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    study = run_sweep(sweep_of(program, run_cap=5), tmp_path / "sweep", parallel=2, tell=lambda line: None)
    with serving("optuna-dashboard", tmp_path / "sweep" / "journal.log") as address:
        browser.page.goto(address)
        browser.wait_for("0. toy", "Direction: MINIMIZE")
        browser.page.get_by_text("0. toy").click()
        browser.wait_for(f"Best Trial (number={study.best_trial.number})", f"Params = [x: {study.best_params['x']}]")
        browser.page.goto(f"{address}dashboard/studies/0/trials")
        browser.wait_for(*(f"Trial {number}" for number in range(5)), f"Parameter x {study.trials[0].params['x']}")
    browser.assert_at_home()
