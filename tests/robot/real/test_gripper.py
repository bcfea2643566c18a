"""The jaws: Robotiq's words over a real socket, and a digital output."""

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stackgen.errors import StackgenError
from stackgen.robot.real import gripper
from stackgen.robot.real.gripper import DigitalJaws, Gripper, RealJaws, RobotiqJaws
from tests.robot.real.arms import stand_in


@given(st.floats(0, 0.085))
def test_an_opening_survives_being_a_position(width: float) -> None:
    gripper = Gripper()
    assert gripper.opening(gripper.position(width)) == pytest.approx(width, abs=0.5 * gripper.stroke / 255 + 1e-12)


@given(st.floats(0, 500), st.floats(0, 500))
def test_more_force_is_no_smaller_a_number_in_a_byte(a: float, b: float) -> None:
    small, large = Gripper().force(min(a, b)), Gripper().force(max(a, b))
    assert 0 <= small <= large <= 255


def test_robotiq_jaws_are_activated_open_close_and_tell_what_they_hold(tmp_path: Path) -> None:
    ticks = []
    with stand_in(tmp_path, "--grasps", "01") as controller:
        jaws = RobotiqJaws(Gripper(), controller.host, lambda: ticks.append(1))
        jaws.activate()
        assert jaws.get("STA") == 3
        jaws.open(0.085)
        assert jaws.opening() == pytest.approx(0.085)
        jaws.close(235)
        assert not jaws.holds() and jaws.opening() == 0
        jaws.open(0.06)
        jaws.close(20)
        assert jaws.holds() and jaws.opening() == pytest.approx(0.05, abs=0.001)
        jaws.disconnect()
        orders = controller.events("jaws")
    assert [order["POS"] for order in orders] == [0, 255, 75, 255]
    assert [order["FOR"] for order in orders] == [0, 255, 0, 0]


def test_jaws_that_are_not_there_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(StackgenError, match=r"no Robotiq gripper answers at 127\.0\.0\.1:9 "):
        RobotiqJaws(Gripper(port=9), "127.0.0.1")


def test_jaws_that_go_away_are_one_line(tmp_path: Path) -> None:
    with stand_in(tmp_path) as controller:
        jaws = RobotiqJaws(Gripper(), controller.host)
    with pytest.raises(StackgenError, match="lost the gripper at"):
        jaws.open(0.05)


def _drips(link: socket.socket) -> None:
    while True:
        link.sendall(b"P")
        time.sleep(0.2)


def _says_nothing(link: socket.socket) -> None:
    link.recv(100)
    time.sleep(10)


def _floods(link: socket.socket) -> None:
    while True:
        link.sendall(b"x" * 65536)


@pytest.mark.parametrize("handle", [_drips, _floods, _says_nothing])
def test_jaws_that_drip_flood_or_say_nothing_are_one_line_soon(
    handle: Callable[[socket.socket], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert gripper._PATIENCE <= 3
    monkeypatch.setattr(gripper, "_PATIENCE", 0.5)

    def serve() -> None:
        link, _ = listener.accept()
        with link, suppress(OSError):
            handle(link)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        jaws, begin = RobotiqJaws(Gripper(port=listener.getsockname()[1]), "127.0.0.1"), time.monotonic()
        with pytest.raises(StackgenError, match="lost the gripper") as error:
            jaws.opening()
        jaws.disconnect()
    assert str(error.value).isprintable() and time.monotonic() - begin < 4


@pytest.mark.parametrize("closed", [True, False])
def test_digital_jaws_switch_their_output(closed: bool) -> None:
    switched: list[tuple[int, bool]] = []
    jaws: RealJaws = DigitalJaws(
        Gripper(kind="digital", output=5, closed=closed, seconds=0.01), lambda *s: switched.append(s)
    )
    jaws.open(0.085)
    jaws.close(40)
    assert switched == [(5, not closed), (5, closed)]
    assert jaws.holds() is None and jaws.opening() is None


@pytest.mark.parametrize("bad", [{"stroke": 0.0}, {"speed": 2.0}, {"output": 8}, {"port": 0}, {"weakest": 300.0}])
def test_numbers_that_make_no_sense_are_named(bad: dict[str, float]) -> None:
    with pytest.raises(StackgenError, match=next(iter(bad))):
        Gripper(**bad)  # type: ignore[arg-type]
