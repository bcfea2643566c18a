"""How quick the studio answers, and whether any request of its schema makes it stumble.

A studio is started as a user starts it. Times are those of a client on this machine: of the page's three files, of the
first message of noise, and of three verified stacks. In Chromium, where there is one, the page plays how the arm builds
ten blocks, and Chromium counts the processor time that the page takes for a frame: the picture is one pixel large
meanwhile, so that a machine without a graphics card does not wait for its painting. The fuzzer makes requests by the
OpenAPI schema that the studio publishes, most of them with something wrong in it, and counts the statuses.
"""

from __future__ import annotations

import argparse
import copy
import json
import random
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.client import HTTPConnection, HTTPResponse
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.common import ROOT, argument_parser, plain_table, report, start, summary
from stackgen.studio.work.drawings import pack
from stackgen.studio.work.methods import BEST

LEANING = {
    "format": "stackgen.stacks/1",
    "cell_size_m": 0.05,
    "seed": 0,
    "physics": {"engine": "bullet", "cell_size": 0.05, "friction": 0.5, "density": 600.0, "gravity": 9.81},
    "grid": {"width": 4, "height": 4, "image_size": 64, "pixels_per_cell": 14.0, "ground_margin": 4.0},
    "stacks": [
        {"blocks": [{"shape": "cube", "position": [x, 0, z], "rotation": [0, 0, 0]} for x, z in ((0, 0.5), (0.6, 1.5))]}
    ],
}
"""A stack that falls, so that no arm builds it."""

TEN = [{"shape": "cube", "position": [i - (row - 1) / 2, 0, 4.5 - row]} for row in (4, 3, 2, 1) for i in range(row)]
"""Blocks of a pyramid, which the arm builds."""

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
GRAPHICS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WATCHED = 10.0  # [s]

_WATCH = """
window.seen = { frames: 0, calls: 0, triangles: 0 };
const ask = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (frame) => ask((now) => {
  window.seen.frames++;
  frame(now);
});
const graphics = WebGL2RenderingContext.prototype;
const { viewport } = graphics;
graphics.viewport = function () {
  viewport.call(this, 0, 0, 1, 1);
};
for (const [name, place] of [["drawElements", 1], ["drawArrays", 2]]) {
  const draw = graphics[name];
  graphics[name] = function (...how) {
    window.seen.calls++;
    if (how[0] === this.TRIANGLES) window.seen.triangles += how[place] / 3;
    draw.apply(this, how);
  };
}
"""
"""Counts frames, and what is drawn in them, shadows too; the picture is one pixel large."""

VALID = 0.03
"""Share of the requests in which nothing is wrong."""

_HEAVY = {"/api/build", "/api/generate", "/api/export"}
_ODD: tuple[Any, ...] = (
    *(None, True, -1, 0, 1e308, -1e308, 2**63, 10**30, 1e-320, "", "\ud800", "\x00", "../../etc/passwd", "a" * 5000),
    *([], {}, [[]], {"": {}}, [None] * 100, float("nan"), float("inf")),
)


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argument_parser(__name__, __doc__)
    options.add_argument("--runs", type=int, default=10, help="repetitions of what is timed")
    options.add_argument("--requests", type=int, default=5000, help="requests of the fuzzer")
    options.add_argument("--seed", type=int, default=0, help="seed of the fuzzer")
    return options


def main() -> None:
    """Measure, then fuzz."""
    chosen = parser().parse_args()
    with studio() as address:
        times = {name: summary([one(address) for _ in range(chosen.runs)]) for name, one in TIMED.items()}
        frames = drawn(address) if CHROMIUM and find_spec("playwright") else None
        statuses = fuzzed(address, chosen.requests, random.Random(chosen.seed))
        alive = ask(address, "GET", "/api/start")[0] == 200
    metrics = {"seconds": times, "frames": frames, "requests": chosen.requests, "statuses": statuses, "alive": alive}
    rows = [[name, f"{t['median']:.3f}", f"{t['min']:.3f}", f"{t['max']:.3f}"] for name, t in times.items()]
    tables = [plain_table("seconds", ("what", "median", "least", "most"), rows)]
    if frames:
        shown = [[name, f"{value:.1f}"] for name, value in frames.items()]
        tables += [plain_table("the page draws the arm and ten blocks", ("what", "value"), shown)]
    tables += [plain_table("fuzzer", ("status", "answers"), [[s, str(n)] for s, n in statuses.items()])]
    report("studio", metrics, tables, chosen.out)


@contextmanager
def studio() -> Iterator[str]:
    """Run a studio, and yield host and port once it is warm."""
    command = [sys.executable, "-m", "stackgen", "studio", "--port", "0"]
    with TemporaryDirectory() as gallery:
        pyramid = {"format": "stackgen.stacks/1", "stacks": [{"blocks": TEN}]}
        (Path(gallery) / "stacks.json").write_text(json.dumps(pyramid))
        with serving([*command, "--gallery", gallery]) as address:
            yield address


@contextmanager
def serving(command: list[str]) -> Iterator[str]:
    """Run a command that serves a studio, and yield host and port once it is warm."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as server:
        assert server.stdout is not None
        found = re.search(r"http://\S+/", server.stdout.readline())
        assert found
        address = urlsplit(found.group()).netloc
        for method in ("taught-verdicts", "taught-verdicts", "ddpm-verdicts", "ddpm-verdicts"):  # in both processes
            ask(address, "POST", "/api/generate", wish(method=method))
        yield address
        server.terminate()


def wish(seed: int = 0, method: str = "taught-verdicts") -> dict[str, Any]:
    """Ask for three verified stacks, as the page does."""
    arch = np.ones((56, 56), dtype=bool)
    arch[14:, 14:42] = False
    sampler = {} if method == BEST else {"kind": "dpm", "steps": 10}
    wanted = {"method": method, "sampler": sampler, "seed": seed}
    return {"drawing": {"cells": 4, "bits": pack(arch)}, "wish": wanted}


@contextmanager
def asked(address: str, method: str, path: str, body: Any = None) -> Iterator[HTTPResponse]:
    """Ask, and yield what is answered as it comes."""
    connection = HTTPConnection(address, timeout=600)
    content = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
    connection.request(method, path, content, {"Content-Type": "application/json"})
    yield connection.getresponse()
    connection.close()


def ask(address: str, method: str, path: str, body: Any = None) -> tuple[int, bytes]:
    """Ask, and return status and answer."""
    with asked(address, method, path, body) as answer:
        return answer.status, answer.read()


def page(address: str) -> float:
    """Time all that the page asks for before it can be drawn on [s]."""
    began = time.perf_counter()
    for path in ("/", "/studio.css", "/studio.js", "/api/start"):
        assert ask(address, "GET", path)[0] == 200
    return time.perf_counter() - began


def first_frame(address: str) -> float:
    """Time the first frame of the noise [s]."""
    began = time.perf_counter()
    with asked(address, "POST", "/api/generate", wish(1)) as answer:
        while b'"noise"' not in answer.readline():
            pass
        seconds = time.perf_counter() - began
        answer.read()
        return seconds


def three_stacks(address: str, method: str) -> float:
    """Time three stacks, verified and explained [s]."""
    began = time.perf_counter()
    status, content = ask(address, "POST", "/api/generate", wish(int(began * 1e6) % 1000, method))
    assert status == 200 and content.count(b'"kind": "stack"') == 3
    return time.perf_counter() - began


TIMED: dict[str, Callable[[str], float]] = {
    "the page, all of it": page,
    "three stacks, search and network": partial(three_stacks, method=BEST),
    "three verified stacks, taught-verdicts": partial(three_stacks, method="taught-verdicts"),
    "three verified stacks, ddpm-verdicts": partial(three_stacks, method="ddpm-verdicts"),
    "first frame of the noise": first_frame,
}
"""What is timed."""


def drawn(address: str) -> dict[str, float]:
    """Have the arm build ten blocks, and measure what the page does for a frame of it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=list(GRAPHICS), timeout=600_000)
        page = chromium.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(600_000)
        page.add_init_script(_WATCH)
        page.goto(f"http://{address}/")
        page.get_by_role("button", name="Gallery").click()
        page.get_by_role("button", name="stacks.json").click()
        page.locator(".pane[data-done]").first.wait_for()
        page.get_by_label("Speed").first.select_option("1")
        page.get_by_role("button", name="Have the arm build it").first.click()
        page.locator(".badge", has_text="building").first.wait_for()
        page.locator(".build .answer", has_text="Built").first.wait_for()
        page.get_by_role("button", name="Previous block").first.click()  # nothing is simulated any more
        page.get_by_role("button", name="Play").first.click()
        chrome = page.context.new_cdp_session(page)
        chrome.send("Performance.enable", {"timeDomain": "threadTicks"})
        before = _seen(page, chrome)
        page.wait_for_timeout(1000 * WATCHED)
        seen = {name: value - before[name] for name, value in _seen(page, chrome).items()}
        chromium.close()
    frames = seen["frames"]
    return {
        "frames in a second": frames / WATCHED,
        "processor time of the page for a frame [ms]": 1000 * seen["TaskDuration"] / frames,
        "of it in scripts [ms]": 1000 * seen["ScriptDuration"] / frames,
        "draw calls for a frame": seen["calls"] / frames,
        "triangles in a frame": seen["triangles"] / frames,
    }


def _seen(page: Any, chrome: Any) -> dict[str, float]:
    """Read what was counted so far, by the page and by Chromium."""
    metrics = chrome.send("Performance.getMetrics")["metrics"]
    return {**page.evaluate("seen"), **{metric["name"]: metric["value"] for metric in metrics}}


def fuzzed(address: str, number: int, chance: random.Random) -> dict[str, int]:
    """Make requests by the schema, and count the statuses; a request without an answer counts as `none`."""
    schema = json.loads(ask(address, "GET", "/openapi.json")[1])
    targets = [(path, method.upper(), told) for path, by in schema["paths"].items() for method, told in by.items()]
    statuses: Counter[str] = Counter()
    often = [1 if path in _HEAVY else 6 for path, _, _ in targets]
    for path, method, told in chance.choices(targets, often, k=number):
        valid = chance.random() < VALID
        body = None
        if "requestBody" in told:
            model = told["requestBody"]["content"]["application/json"]["schema"]
            body = made(model, schema, chance)
            body = body if valid else spoilt(body, chance)
        item = chance.choice(["0123456789abcdef", "..%2f..%2fetc%2fpasswd", "x", "%00", "a" * 3000])
        try:
            status = str(ask(address, method, path.replace("{item}", item), body)[0])
        except OSError as error:
            status = f"none: {error}"
        statuses[status] += 1
        if not status.startswith(("2", "4")):
            print(f"{status} {method} {path} {str(body)[:300]}", file=sys.stderr)
    return dict(sorted(statuses.items()))


def made(model: dict[str, Any], schema: dict[str, Any], chance: random.Random) -> Any:
    """Make a value of a schema."""
    if "$ref" in model:
        model = schema["components"]["schemas"][model["$ref"].rpartition("/")[2]]
    if "anyOf" in model:
        return made(chance.choice(model["anyOf"]), schema, chance)
    if "enum" in model or "const" in model:
        return chance.choice(model.get("enum") or [model["const"]])
    if model.get("title") == "File":
        return copy.deepcopy(LEANING)
    if model.get("title") == "Bits":
        return wish()["drawing"]["bits"]
    kind = model.get("type")
    if kind == "object":
        known = {name: made(inner, schema, chance) for name, inner in model.get("properties", {}).items()}
        return known or {"cube": chance.randint(0, 9)}
    low, high = model.get("minimum", 0), model.get("maximum", 10)
    simple = {"integer": chance.randint(int(low), int(high)), "number": chance.uniform(low, high)}
    return {**simple, "boolean": chance.random() < 0.5, "string": "search", "null": None}.get(str(kind), "")


def spoilt(value: Any, chance: random.Random) -> Any:
    """Put something wrong in one place, or make it no JSON at all."""
    if chance.random() < 0.05:
        whole = json.dumps(value).encode()
        cut = chance.randrange(len(whole))
        return chance.choice([whole[:cut], whole + b"}", b"[" * 50_000, b"\xff" + whole, whole.replace(b":", b"=")])
    value = copy.deepcopy(value)
    places = list(_places(value))
    if not places:
        return chance.choice(_ODD)
    inside, key = chance.choice(places)
    how = chance.random()
    if how < 0.2 and isinstance(inside, dict):
        del inside[key]
    elif how < 0.3 and isinstance(inside, dict):
        inside["unknown"] = chance.choice(_ODD)
    elif how < 0.4 and isinstance(inside[key], list):
        inside[key] = inside[key] * chance.choice([0, 2, 60])
    else:
        inside[key] = chance.choice(_ODD)
    return value


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Name every place in a value by what it is in and its key."""
    keys: list[Any] = list(value) if isinstance(value, dict) else list(range(len(value)))
    for key in keys:
        yield value, key
        if isinstance(value[key], dict | list):
            yield from _places(value[key])


if __name__ == "__main__":
    start(main)
