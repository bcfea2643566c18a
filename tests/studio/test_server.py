"""The studio answers what is right, refuses the rest in one sentence, and lets nobody else in."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from stackgen.studio.gallery import Gallery
from stackgen.studio.guard import MOST_BYTES
from stackgen.studio.server import make_app
from stackgen.studio.work.drawings import pack
from stackgen.studio.workers import Workers

ARCH = np.ones((56, 56), dtype=bool)
ARCH[14:, 14:42] = False
DRAWING = {"cells": 4, "bits": pack(ARCH)}
LEANING = [{"shape": "cube", "position": [x, 0, z]} for x, z in ((0, 0.5), (0.6, 1.5))]
TOWER = [{"shape": "cube", "position": [0, 0, z]} for z in (0.5, 1.5)]


def file_of(blocks: list[dict[str, Any]]) -> dict[str, Any]:
    return {"format": "stackgen.stacks/1", "stacks": [{"blocks": blocks}]}


def told(answer: Any, status: int) -> str:
    assert answer.status_code == status, answer.text
    assert list(answer.json()) == ["detail"]
    sentence = answer.json()["detail"]
    assert sentence.isprintable() and len(sentence) < 400
    return sentence


def test_the_page_asks_for_three_files_and_nothing_from_outside(studio: TestClient) -> None:
    page = studio.get("/")
    asked = re.findall(r'(?:src|href)="([^"#]*)"', page.text)
    assert sorted(asked) == ["api", "data:,", "studio.css", "studio.js"]
    assert "default-src 'none'" in page.headers["content-security-policy"]
    for name in ("studio.css", "studio.js", "api"):
        answer = studio.get(f"/{name}")
        assert answer.status_code == 200
        assert not re.search(r"""(?:src|href|url\(|from|import\()\s*=?\s*["'(]?https?:""", answer.text), name


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 421),
        ({"Host": "[::1"}, 421),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://127.0.0.1:9000"}, 403),
        ({"Origin": "null"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Content-Length": str(MOST_BYTES + 1)}, 413),
        ({"Content-Length": "-1"}, 413),
        ({"X-Client": "../.."}, 422),
    ],
)
def test_others_are_kept_out(studio: TestClient, headers: dict[str, str], status: int) -> None:
    told(studio.post("/api/check", json={"file": file_of(TOWER)}, headers=headers), status)


@pytest.mark.parametrize(
    ("host", "status"), [("192.168.1.7:8011", 200), ("[fe80::1]:8011", 200), ("evil.example", 421)]
)
def test_who_listens_at_all_addresses_is_reached_by_them_but_by_no_name(host: str, status: int, results: Path) -> None:
    app = make_app(Workers(1), Gallery(results), ("0.0.0.0",))
    assert TestClient(app).get("/studio.css", headers={"Host": host}).status_code == status


def test_a_body_that_goes_on_is_cut_off(studio: TestClient) -> None:
    parts = (b" " * 1_000_000 for _ in range(MOST_BYTES // 1_000_000 + 2))  # without a length beforehand
    told(studio.post("/api/read", content=parts, headers={"Content-Type": "application/json"}), 413)


def test_its_own_page_is_let_in_and_no_websocket_is(studio: TestClient) -> None:
    own = {"Origin": "http://127.0.0.1:8011", "Sec-Fetch-Site": "same-origin"}
    assert studio.get("/api/start", headers=own).status_code == 200
    with pytest.raises(Exception), studio.websocket_connect("/api/generate"):  # noqa: B017, PT011
        pass


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("generate", {}),
        ("generate", {"drawing": DRAWING, "more": 1}),
        ("generate", {"drawing": {"cells": 4, "bits": ""}}),
        ("generate", {"drawing": {"cells": 4, "bits": pack(np.zeros((56, 56), bool))}}),
        ("generate", {"drawing": {"cells": 99, "bits": DRAWING["bits"]}}),
        ("generate", {"drawing": DRAWING, "wish": {"method": "../../etc/passwd"}}),
        ("generate", {"drawing": DRAWING, "wish": {"method": "no-such"}}),
        ("generate", {"drawing": DRAWING, "wish": {"number": 1e9}}),
        ("generate", {"drawing": DRAWING, "wish": {"inventory": {"cube": 1}, "blocks": {"cube": 1}}}),
        ("generate", {"drawing": DRAWING, "wish": {"blocks": {"ball": 1}}}),
        ("read", {"picture": "!"}),
        ("read", {"picture": base64.b64encode(b"no picture").decode()}),
        ("check", {"file": {}}),
        ("check", {"file": file_of(TOWER), "stack": 1}),
        ("check", {"file": file_of([])}),
        ("check", {"file": file_of([{"shape": "cube", "position": [0, 0, 1e300]}])}),
        ("tilt", {"file": file_of(TOWER), "degrees": 90}),
        ("push", {"file": file_of(TOWER), "block": 2, "force": 1}),
        ("build", {"file": file_of(LEANING)}),
        ("export", {"file": file_of(TOWER), "format": "exe"}),
    ],
)
def test_bad_requests_get_one_sentence(studio: TestClient, path: str, body: dict[str, Any]) -> None:
    told(studio.post(f"/api/{path}", json=body), 422)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff", b'{"file": {"a": NaN}}', b'{"file":' + b"[" * 100_000])
def test_bodies_that_are_no_request_get_one_sentence(studio: TestClient, content: bytes) -> None:
    answer = studio.post("/api/check", content=content, headers={"Content-Type": "application/json"})
    told(answer, answer.status_code)
    assert answer.status_code in (400, 422)


def test_what_is_not_there_is_not_found(studio: TestClient) -> None:
    for path in ("/nothing", "/..%2f..%2fsetup.cfg", "/api/gallery/0123456789abcdef"):
        told(studio.get(path), 404)
    told(studio.get("/api/generate"), 405)


def test_a_drawing_becomes_stacks_that_stand_and_match(studio: TestClient) -> None:
    answer = studio.post("/api/generate", json={"drawing": DRAWING, "wish": {"number": 1}})
    file, *stacks = [json.loads(line) for line in answer.text.splitlines()]
    assert [stack["kind"] for stack in stacks] == ["stack"] * len(file["file"]["stacks"])
    for stack in stacks:
        assert stack["stable"] and stack["views"]["front"]["iou"] > 0.95
        assert len(stack["frames"][0]) == len(stack["shapes"]) == len(stack["statics"]["centers"])


def test_denoising_is_told_step_by_step(studio: TestClient) -> None:
    wish = {"method": "ddpm-verdicts", "number": 2, "verified": False, "sampler": {"kind": "dpm", "steps": 4}}
    answer = studio.post("/api/generate", json={"drawing": DRAWING, "wish": wish})
    messages = [json.loads(line) for line in answer.text.splitlines()]
    kinds = [message["kind"] for message in messages]
    assert kinds == ["blocks", *["noise"] * 5, "checked", "checked", "file", "stack", "stack"]
    noise = np.array([message["stacks"] for message in messages if message["kind"] == "noise"])
    assert noise.shape == (5, 2, len(messages[0]["shapes"]), 7)
    assert noise[-1, 0, :, :3] == pytest.approx(np.array(messages[-2]["frames"][0])[:, :3], abs=2e-3)


def test_a_tower_on_a_tilted_table_falls_where_statics_says(studio: TestClient) -> None:
    # Four cubes topple long before they slide, and what slides does not fall.
    file = file_of([{"shape": "cube", "position": [0, 0, z + 0.5]} for z in range(4)])
    margin = studio.post("/api/check", json={"file": file}).json()["statics"]["margin"]
    below = studio.post("/api/tilt", json={"file": file, "degrees": 0.6 * margin}).json()
    assert below["stable"] and below["fell_at"] is None and below["reached"] == 0.6 * margin
    above = studio.post("/api/tilt", json={"file": file, "degrees": 45, "direction": 90}).json()
    assert not above["stable"] and above["first"] == 3
    assert above["fell_at"] == pytest.approx(margin, abs=1)
    assert above["fell_at"] <= above["reached"] < margin + 4  # where the hand stops


def test_a_push_fells_the_block_that_friction_no_longer_holds(studio: TestClient) -> None:
    answer = studio.post("/api/push", json={"file": file_of(TOWER), "block": 1, "force": 1}).json()
    assert answer["fell"] == [1]
    assert answer["fell_at"] == pytest.approx(0.5, abs=0.05)


def test_what_leans_falls_and_is_explained(studio: TestClient) -> None:
    facts = studio.post("/api/check", json={"file": file_of(LEANING)}).json()
    assert not facts["stable"]
    assert facts["fell"] == [1] and facts["first"] == 1
    assert "0.10 cells beside its support" in facts["statics"]["reasons"]["1"]


@pytest.mark.slow
def test_a_picture_becomes_a_drawing(studio: TestClient) -> None:
    content = Path("examples/photos/sketch-house.jpg").read_bytes()
    facts = studio.post("/api/read", json={"picture": base64.b64encode(content).decode(), "cells": 5}).json()
    assert facts["kind"] == "photo"
    again = studio.post("/api/generate", json={"drawing": {"cells": 5, "bits": facts["bits"]}, "wish": {"number": 1}})
    assert json.loads(again.text.splitlines()[-1])["views"]["front"]["iou"] > 0.7


def test_a_stack_is_exported(studio: TestClient) -> None:
    glb = studio.post("/api/export", json={"file": file_of(TOWER), "format": "glb"})
    assert glb.headers["content-type"] == "model/gltf-binary"
    assert glb.content.startswith(b"glTF")


def test_the_gallery_shows_what_is_there_and_follows_no_links(studio: TestClient, results: Path) -> None:
    outside = results.parent / f"{results.name}-outside"
    outside.mkdir()
    (outside / "secret.csv").write_text("a,b\n")
    (results / "link").symlink_to(outside)
    (results / "run").mkdir()
    (results / "run/metrics.csv").write_text("step,loss\n1,0.5\n")
    (results / "run/stacks.json").write_text(json.dumps(file_of(TOWER)))
    (results / "run/.hidden.png").write_bytes(b"")
    (results / "run/table.md").write_text(
        "# A <b>\n\n![c](chart%20a.png) [r](../../x.md) [s](https://a.example)\n\n|a|\n|-|\n|1|\n"
    )
    (results / "run/chart a.png").write_bytes(b"png")
    (results / "run/stacks.html").write_text("<script>1</script>")
    items = {item["name"]: item for item in studio.get("/api/gallery").json()}
    assert sorted(items) == ["chart a.png", "metrics.csv", "stacks.html", "stacks.json", "table.md"]
    report = studio.get(f"/api/gallery/{items['table.md']['id']}")
    chart = f'<img alt="c" src="/api/gallery/{items["chart a.png"]["id"]}" />'
    assert f"{chart} <a>r</a> <a>s</a>" in report.text and "A &lt;b&gt;" in report.text and "<td>1</td>" in report.text
    page = studio.get(f"/api/gallery/{items['stacks.html']['id']}")
    for answer, policy in ((report, "script-src"), (page, "sandbox allow-scripts;")):
        (told_policy,) = answer.headers.get_list("content-security-policy")
        assert (policy in told_policy) == (answer is page)
    table = studio.get(f"/api/gallery/{items['metrics.csv']['id']}").json()
    assert table["rows"] == [["step", "loss"], ["1", "0.5"]]
    stacks = studio.get(f"/api/gallery/{items['stacks.json']['id']}").json()
    assert len(stacks["file"]["stacks"]) == 1 and stacks["shapes"][0]["name"] == "cube"
    (results / "run/stacks.json").write_text("{")
    assert str(results) not in told(studio.get(f"/api/gallery/{items['stacks.json']['id']}"), 404)
