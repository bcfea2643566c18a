"""Whatever answers in the place of a controller's dashboard, the result is one line, soon, and the process goes on."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest

from stackgen.errors import StackgenError
from stackgen.robot.real import readiness
from stackgen.robot.real.readiness import require_ready

GREETING = b"Connected: Universal Robots Dashboard Server\n"
READY = {
    "PolyscopeVersion": "URSoftware 5.11.0.1000 (Jan 01 2024)",
    "is in remote control": "true",
    "safetymode": "Safetymode: REDUCED",
    "robotmode": "Robotmode: RUNNING",
    "programState": "STOPPED <unnamed>",
}


def silent(link: socket.socket) -> None:
    link.recv(100)


def greets_and_is_silent(link: socket.socket) -> None:
    link.sendall(GREETING)
    while link.recv(100):
        pass


def greets_and_closes(link: socket.socket) -> None:
    link.sendall(GREETING)


def drips(link: socket.socket) -> None:
    link.sendall(GREETING)
    while True:
        link.sendall(b"x")
        time.sleep(0.2)


def drips_at_once(link: socket.socket) -> None:
    while True:
        link.sendall(b"x")
        time.sleep(0.2)


def floods_with_lines(link: socket.socket) -> None:
    while True:
        link.sendall(GREETING * 1000)


def floods(link: socket.socket) -> None:
    link.sendall(GREETING)
    while True:
        link.sendall(bytes(65536))


def says(answers: dict[str, str], end: bytes = b"\n") -> Callable[[socket.socket], None]:
    def answer(link: socket.socket) -> None:
        link.sendall(GREETING)
        for line in link.makefile("r"):
            link.sendall(answers.get(line.strip(), "could not understand").encode("latin-1") + end)

    return answer


@contextmanager
def dashboard(handle: Callable[[socket.socket], None], monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Serve one, on a port of its own."""

    def serve() -> None:
        with suppress(OSError):
            link, _ = listener.accept()
            with link, suppress(OSError):
                handle(link)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        monkeypatch.setattr(readiness, "PORT", listener.getsockname()[1])
        threading.Thread(target=serve, daemon=True).start()
        yield


def test_an_arm_that_is_ready_is_let_through(monkeypatch: pytest.MonkeyPatch) -> None:
    with dashboard(says(READY), monkeypatch):
        require_ready("127.0.0.1")


@pytest.mark.parametrize(
    "handle",
    [
        silent,
        greets_and_is_silent,
        greets_and_closes,
        drips,
        drips_at_once,
        floods,
        floods_with_lines,
        says({}),
        says(dict.fromkeys(READY, "URSoftware five")),
        says(dict.fromkeys(READY, "\xff\xfe")),
        says(READY | {"safetymode": "\xff\xfe"}),
        says(READY | {"robotmode": "\x1b[2JRobotmode: RUNNING"}),
    ],
)
def test_what_is_no_dashboard_is_one_line_within_seconds(
    handle: Callable[[socket.socket], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert readiness._PATIENCE <= 3
    monkeypatch.setattr(readiness, "_PATIENCE", 0.5)
    begin = time.monotonic()
    with dashboard(handle, monkeypatch), pytest.raises(StackgenError, match=r"answer") as error:
        require_ready("127.0.0.1")
    assert str(error.value).isprintable() and time.monotonic() - begin < 4


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"is in remote control": "false"}, "local mode: switch it to remote control"),
        ({"safetymode": "Safetymode: ROBOT_EMERGENCY_STOP"}, "safety mode ROBOT_EMERGENCY_STOP"),
        ({"robotmode": "Robotmode: IDLE"}, "mode IDLE: switch it on"),
        ({"programState": "PLAYING a.urp"}, r"has a program going \(PLAYING a\.urp\)"),
    ],
)
def test_an_arm_that_is_not_ready_is_one_line(
    changed: dict[str, str], line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with dashboard(says(READY | changed), monkeypatch), pytest.raises(StackgenError, match=line):
        require_ready("127.0.0.1")
