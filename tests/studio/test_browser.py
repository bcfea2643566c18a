"""The studio in a real Chromium: draw, generate, compare, tilt, build, download, come back, at three window sizes."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stackgen.io.stacks_file import read_stacks
from stackgen.sim.checkers import SimulatorChecker
from stackgen.viz.page import write_html

playwright = pytest.importorskip("playwright.sync_api", reason="drives the browser: pip install playwright")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PATIENCE = 300_000  # [ms]
SIZES = {"desktop": (1500, 950), "tablet": (1000, 1200), "phone": (390, 844)}
Rectangles = tuple[tuple[tuple[float, float], tuple[float, float]], ...]
GATE: Rectangles = (((0.05, 0.3), (0.2, 0.95)), ((0.8, 0.3), (0.95, 0.95)), ((0.05, 0.05), (0.95, 0.2)))
POST: Rectangles = (((0.3, 0.55), (0.45, 0.95)),)  # of two blocks, which are soon built
OWN = ("data:", "blob:", "about:")
GRAPHICS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # without a graphics card
SHIFTS = """
window.shifted = 0;
const added = (list) => {
  for (const entry of list.getEntries()) if (!entry.hadRecentInput) window.shifted += entry.value;
};
new PerformanceObserver(added).observe({ type: "layout-shift", buffered: true });
"""
AXE = Path("studio/node_modules/axe-core/axe.min.js")  # by `npm ci` in studio/

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, chromium-browser or google-chrome on the PATH"),
]


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A studio that runs, with one result to show."""
    results = tmp_path_factory.mktemp("results")
    shutil.copy("examples/stacks/cantilever.json", results / "stacks.json")
    (results / "report.csv").write_text("a\n7\n")
    (results / "report.md").write_text("| a |\n| - |\n| 7 |\n")
    command = [sys.executable, "-m", "stackgen", "studio", "--port", "0", "--workers", "2", "--gallery", str(results)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stdout
        found = re.search(r"http://\S+/", server.stdout.readline())
        assert found
        yield found.group()
        server.terminate()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """One browser for all tests."""
    with playwright.sync_playwright() as driver:
        yield driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *GRAPHICS], timeout=PATIENCE)


@pytest.fixture
def page(request: pytest.FixtureRequest, address: str, chromium: Any) -> Iterator[Any]:
    """The page, in a window of its own; it asks nobody else, and no error is heard."""
    width, height = SIZES[getattr(request, "param", "desktop")]
    heard: list[str] = []
    # With little motion, so that a machine without a graphics card has little to draw.
    context = chromium.new_context(viewport={"width": width, "height": height}, reduced_motion="reduce")
    context.add_init_script(SHIFTS)
    page = context.new_page()
    page.set_default_timeout(PATIENCE)
    page.on("pageerror", lambda error: heard.append(str(error)))
    page.on("request", lambda asked: heard.extend([asked.url] * (not asked.url.startswith((address, *OWN)))))
    page.goto(address)
    page.locator("#method").wait_for()
    yield page
    context.close()
    assert heard == []


def drag(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw from one place to another, in shares of the paper."""
    box = page.locator("#sketch").bounding_box()
    page.mouse.move(box["x"] + start[0] * box["width"], box["y"] + start[1] * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + end[0] * box["width"], box["y"] + end[1] * box["height"], steps=4)
    page.mouse.up()


def draw(page: Any, rectangles: Rectangles) -> None:
    page.get_by_role("button", name="Clear").click()
    page.locator("#sketch").scroll_into_view_if_needed()
    for start, end in rectangles:
        drag(page, start, end)


def slide(page: Any, name: str, value: float) -> None:
    change = "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); e.dispatchEvent(new Event('change')); }"
    page.get_by_label(name).first.evaluate(change, str(value))


def saved(page: Any, name: str) -> Path:
    with page.expect_download() as download:
        page.get_by_role("button", name=name, exact=True).first.click()
    return Path(download.value.path())


def drawn(page: Any) -> str:
    return str(page.evaluate("localStorage.getItem('stackgen-studio')"))


def generate(page: Any, compared: str = "") -> None:
    page.select_option("#compared", compared)
    page.locator("#number").fill("1")
    page.locator("#number").blur()
    page.get_by_role("button", name="Generate").click()
    page.locator(".pane[data-done]").nth(1 if compared else 0).wait_for()


@pytest.mark.parametrize("page", SIZES, indirect=True)
def test_what_is_drawn_is_compared_built_and_downloaded(page: Any) -> None:
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    draw(page, POST)
    generate(page, "taught-verdicts")
    assert page.locator(".pane >> visible=true").count() == 2
    assert page.locator(".overlays canvas").count() == 6
    content = json.loads(saved(page, "stacks.json").read_text())
    assert content["stacks"][0]["verdict"]["stable"]
    page.get_by_label("Speed").first.select_option("12")
    page.get_by_role("button", name="Have the arm build it").first.click()
    page.locator("[data-built]").wait_for()
    assert "and it stands" in page.locator(".build .answer").first.text_content()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.evaluate("shifted") < 0.1  # what the web calls good


def test_from_a_drawing_to_files_and_back(page: Any) -> None:
    draw(page, GATE)
    kept = drawn(page)
    page.get_by_role("button", name="Undo").click()
    assert drawn(page) != kept
    page.get_by_role("button", name="Redo").click()
    assert drawn(page) == kept
    generate(page)
    page.get_by_role("button", name="Until it falls").first.click()
    page.locator(".answer.falls").first.wait_for()
    assert "falls at" in page.locator(".badge.falls").first.text_content()
    page.get_by_label("Show weights").first.check()
    assert page.locator(".badge").first.text_content() == "stands"  # on a level table again
    assert saved(page, "GLB").read_bytes().startswith(b"glTF")
    assert saved(page, "PNG").read_bytes().startswith(b"\x89PNG")
    assert saved(page, "silhouette.png").read_bytes().startswith(b"\x89PNG")
    assert b"ftyp" in saved(page, "MP4").read_bytes()[:16]
    page.get_by_role("button", name="Copy a link").click()
    link = page.url
    page.reload()
    page.locator("#method").wait_for()
    assert drawn(page).split(".")[:2] == kept.split(".")[:2]
    page.evaluate("localStorage.clear()")
    page.goto("about:blank")
    page.goto(link)
    page.locator("#method").wait_for()
    page.get_by_role("button", name="Clear").click()
    page.get_by_role("button", name="Undo").click()
    assert drawn(page).split(".")[:2] == kept.split(".")[:2]


def test_an_empty_drawing_is_told_where_it_happened(page: Any) -> None:
    page.get_by_role("button", name="Clear").click()
    page.get_by_role("button", name="Generate").click()
    assert "Nothing is drawn" in page.locator("#asking-error").text_content()


def test_it_is_drawn_with_the_keyboard_alone(page: Any) -> None:
    page.get_by_role("button", name="Clear").click()
    empty = drawn(page)
    page.locator("#sketch").focus()
    for key in ("Space", "ArrowUp", "Space"):
        page.keyboard.press(key)
    assert drawn(page) != empty


def test_results_are_shown_and_opened(page: Any) -> None:
    page.get_by_role("button", name="Gallery").click()
    with page.expect_popup() as shown:
        page.get_by_role("link", name="report.md").click()
    assert shown.value.locator("td").text_content() == "7"
    page.get_by_role("button", name="stacks.json").first.click()
    page.locator(".pane[data-done]").first.wait_for()
    assert page.locator(".tabs button").count() >= 1


@pytest.mark.skipif(not AXE.is_file(), reason="needs axe-core: cd studio && npm ci")
@pytest.mark.parametrize("page", ["phone"], indirect=True)
def test_nothing_keeps_a_screen_reader_out_in_light_and_dark(page: Any) -> None:
    generate(page)
    page.evaluate(AXE.read_text())
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        found = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")["violations"]
        assert [f"{one['id']}: {node['html']}" for one in found for node in one["nodes"]] == []


def test_a_page_of_show_turns_and_settles_without_a_server(chromium: Any, tmp_path: Path) -> None:
    content = read_stacks("examples/stacks/arch.json")
    write_html(tmp_path / "a.html", content.stacks, SimulatorChecker().check_all(content.stacks), "An arch")
    page = chromium.new_page()
    page.set_default_timeout(PATIENCE)
    page.goto((tmp_path / "a.html").as_uri())
    page.get_by_role("button", name="Play").click()
    page.locator(".badge", has_text="stands").wait_for()
    assert page.locator("h1").text_content() == "An arch"
    page.close()
