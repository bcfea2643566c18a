"""What the tests of the real arm share: a small plan, and the stand-in in a process of its own."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stackgen.robot.planning.plan import BuildPlan, plan_build
from stackgen.robot.workcell import Staging, Workcell
from stackgen.sim.physics import Physics
from stackgen.stack import Stack

WORKCELL = replace(Workcell(), staging=Staging(straighten=False))
"""Blocks are taken as they lie, so that plans are short."""

TOWER = Stack(np.array([0, 3]), np.array([[0, 0, 0.5, 0, 0, 0], [0, 0, 1.5, 0, 0, 0]]))
"""A triangle on a cube."""


@cache
def plan(placed: int = 0) -> BuildPlan:
    """Of the tower, some of whose blocks may stand already."""
    return plan_build(TOWER, (0, 1), WORKCELL, Physics(), solver="closed-form", placed=placed)


@dataclass
class StandIn:
    """A running stand-in.

    Args:
        host: Its address.
        log: Its file of events.
    """

    host: str
    log: Path

    def events(self, *kinds: str) -> list[dict[str, Any]]:
        """What happened; of some kinds only."""
        found = [json.loads(line) for line in self.log.read_text().splitlines()]
        return [event for event in found if not kinds or event["event"] in kinds]


def free_host() -> str:
    """An address of this machine where nobody listens on a controller's ports: on Linux there are many."""
    if not sys.platform.startswith("linux"):
        pytest.skip("needs the many loopback addresses of Linux: the client's ports cannot be chosen")
    for number in range(20):
        host = f"127.{1 + os.getpid() // 250 % 250}.{1 + os.getpid() % 250}.{number + 1}"
        try:
            for port in (30004, 29999, 30001, 30002, 30003, 63352):
                with socket.create_server((host, port)):
                    pass
            return host
        except OSError:
            continue
    pytest.skip("a controller's ports are taken on this machine")


@contextmanager
def stand_in(folder: Path, *options: str, joints: tuple[float, ...] = WORKCELL.home) -> Iterator[StandIn]:
    """Start one, with the arm at some joint angles [deg]."""
    host, log = free_host(), folder / "standin.jsonl"
    command = [sys.executable, str(Path(__file__).with_name("standin.py")), "--host", host, "--log", str(log)]
    command += [f"--joints={','.join(map(str, joints))}", *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdin is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield StandIn(host, log)
        finally:
            process.stdin.close()
            process.wait(10)
