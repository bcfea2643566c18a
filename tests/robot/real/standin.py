"""A stand-in for a UR controller with a Robotiq gripper, in a process of its own: the ports and words that clients see.

RTDE version 2 on 30004, the dashboard on 29999, script ports on 30001 to 30003, Robotiq's socket on 63352. Instead of
running the client's program it does what that program does: a command in an input register, done in an output register.
Its kinematics are those of the published Denavit-Hartenberg table, not of the URDF. Its log has a line for each event.

Run: python tests/robot/real/standin.py --host 127.0.0.5 --log log.jsonl --joints "-15.8,-103.6,97.7,-84.1,-90,-15.8"
"""

from __future__ import annotations

import argparse
import json
import math
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import cv2
import numpy as np

A = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)
D = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)
ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)

STOPPED, PLAYING = READY, DONE = 1, 2
SAFETY = {"NORMAL": 1, "PROTECTIVE_STOP": 1 << 2}
MOVEJ, MOVEL, SET_PAYLOAD, SET_TCP, SOLVE, STOPL, STOPJ, WATCHDOG, STOP_SCRIPT = 1, 3, 17, 29, 30, 33, 34, 35, 255

TYPES = {  # of the variables that clients ask for
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "runtime_state": "UINT32",
    "safety_status_bits": "UINT32",
    "robot_status_bits": "UINT32",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "external_force_torque": "VECTOR6D",
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
}
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "UINT32": "I", "INT32": "i", "UINT8": "B"}


def type_of(name: str) -> str:
    """RTDE type of a variable."""
    if "double_register" in name:
        return "DOUBLE"
    if "int_register" in name:
        return "INT32"
    return TYPES.get(name, "UINT8")


def forward(joints: np.ndarray, tool: np.ndarray) -> np.ndarray:
    """(4, 4) of the tool in the controller's base frame."""
    frame = np.eye(4)
    for theta, a, d, alpha in zip(joints, A, D, ALPHA, strict=True):
        ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        frame = frame @ [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
    return frame @ matrix(tool)


def matrix(pose: np.ndarray) -> np.ndarray:
    """(4, 4) of a pose (6,)."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = cv2.Rodrigues(np.array(pose[3:], float))[0], pose[:3]
    return frame


def vector(frame: np.ndarray) -> np.ndarray:
    """(6,) of a frame (4, 4)."""
    return np.concatenate([frame[:3, 3], cv2.Rodrigues(frame[:3, :3])[0].ravel()])


def solve(pose: np.ndarray, near: np.ndarray, tool: np.ndarray) -> np.ndarray:
    """Joint angles that lead to a pose, by Newton's method from near ones."""
    goal, joints = matrix(pose), np.array(near, dtype=float)

    def error(q: np.ndarray) -> np.ndarray:
        frame = forward(q, tool)
        turn = goal[:3, :3] @ frame[:3, :3].T  # its skew part is the rotation vector, as long as that is small
        return np.concatenate([goal[:3, 3] - frame[:3, 3], (turn - turn.T)[[2, 0, 1], [1, 2, 0]] / 2])

    for _ in range(30):
        now = error(joints)
        if np.abs(now).max() < 1e-10:
            break
        slope = np.stack([(error(joints + step) - now) / 1e-6 for step in np.eye(6) * 1e-6], axis=1)
        joints = joints - np.linalg.solve(slope, now)
    return joints


class Controller:
    """Arm, program and gripper; one lock around all of it."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.lock = options, threading.RLock()
        self.log_file = open(options.log, "a", buffering=1)  # noqa: SIM115 - as long as the process
        self.joints = np.radians([float(angle) for angle in options.joints.split(",")])
        self.rates, self.tool = np.zeros(6), np.zeros(6)
        self.inputs: dict[str, float] = {}
        self.outputs: dict[str, float] = {"output_int_register_0": 0}
        self.runtime = PLAYING if options.program else STOPPED
        self.safety, self.begin = "NORMAL", time.monotonic()
        self.busy, self.moves = False, 0
        self.way: tuple[float, np.ndarray, np.ndarray] | None = None
        self.written, self.hunger = time.monotonic(), 0.0
        self.digital, self.closes = 0, 0
        self.jaws = {"ACT": 0, "GTO": 0, "STA": 0, "POS": 3, "PRE": 3, "OBJ": 3, "FLT": 0, "FOR": 0, "SPE": 0}

    def log(self, event: str, **more: object) -> None:
        """One line."""
        self.log_file.write(json.dumps({"event": event, **more}) + "\n")

    def read(self, name: str) -> object:
        """A variable's value."""
        values = {
            "timestamp": lambda: time.monotonic() - self.begin + 1,
            "actual_q": lambda: self.joints,
            "actual_qd": lambda: self.rates,
            "actual_TCP_pose": lambda: vector(forward(self.joints, self.tool)),
            "runtime_state": lambda: self.runtime,
            "safety_status_bits": lambda: SAFETY[self.safety],
            "robot_status_bits": lambda: 1 | (2 if self.runtime == PLAYING else 0),
        }
        return values[name]() if name in values else self.outputs.get(name, 0)

    def write(self, names: list[str], values: list[float]) -> None:
        """A package of inputs."""
        with self.lock:
            self.written = time.monotonic()
            self.inputs.update(zip(names, values, strict=True))
            if "standard_digital_output_mask" in names:
                mask, level = int(values[1]), int(values[2])
                self.digital = (self.digital & ~mask) | (level & mask)
                self.log("output", number=mask.bit_length() - 1, level=bool(level & mask))

    def start(self, text: str) -> None:
        """A script has come."""
        with self.lock:
            self.log("script", text=text)
            if "rtde_control" in text:
                self.runtime, self.busy, self.hunger = PLAYING, False, 0.0
                self.outputs["output_int_register_0"] = READY

    def halt(self, why: str) -> None:
        """The program ends."""
        self.log("halt", why=why)
        self.runtime, self.way, self.rates, self.hunger = STOPPED, None, np.zeros(6), 0.0

    def tick(self) -> None:
        """A moment of the controller."""
        with self.lock:
            self._advance()
            if self.runtime != PLAYING or self.options.program:
                return
            if self.hunger and time.monotonic() - self.written > 1 / self.hunger:
                self.halt("watchdog")
                return
            command = int(self.inputs.get("input_int_register_0", 0))
            if command == 0:
                self.busy = False
                self.outputs["output_int_register_0"] = READY
            elif not self.busy:
                self.busy = True
                if command == STOP_SCRIPT:
                    self.halt("asked to")
                    return
                self._obey(command, [self.inputs.get(f"input_double_register_{n}", 0.0) for n in range(14)])
                self.outputs["output_int_register_0"] = DONE

    def _obey(self, command: int, numbers: list[float]) -> None:
        if command in (MOVEJ, MOVEL):
            goal = np.array(numbers[:6])
            joints = goal if command == MOVEJ else solve(goal, self.joints, self.tool)
            name, pose = "movej" if command == MOVEJ else "movel", vector(forward(joints, self.tool)).tolist()
            self.log(name, joints=joints.tolist(), pose=pose, speed=numbers[6], acceleration=numbers[7])
            self.moves += 1
            self.way = (time.monotonic(), self.joints.copy(), joints)
        elif command in (STOPL, STOPJ):
            self.log("brake")
            self.way, self.rates = None, np.zeros(6)
        elif command == SET_TCP:
            self.tool = np.array(numbers[:6])
            self.log("tool", pose=numbers[:6])
        elif command == SET_PAYLOAD:
            self.log("payload", mass=numbers[0])
        elif command == WATCHDOG:
            self.hunger = numbers[0]
        elif command == SOLVE:
            for number, angle in enumerate(solve(np.array(numbers[:6]), np.array(numbers[6:12]), self.tool)):
                self.outputs[f"output_double_register_{number}"] = float(angle)

    def _advance(self) -> None:
        if self.way is None:
            return
        begun, start, goal = self.way
        share = min((time.monotonic() - begun) / self.options.motion, 1.0)
        self.joints, self.rates = start + share * (goal - start), (goal - start) / self.options.motion
        if share > 0.5 and self.moves == self.options.stop_at and self.safety == "NORMAL":
            self.safety = "PROTECTIVE_STOP"
            self.halt("protective stop")
        elif share > 0.5 and self.moves == self.options.drop_at:
            self.log("drop")
            os._exit(0)
        elif share == 1:
            self.way, self.rates = None, np.zeros(6)

    def dashboard(self, line: str) -> str:
        """Its answer to a line."""
        major, minor = map(int, self.options.version.split("."))
        if line == "is in remote control":
            known = (major, minor) >= (5, 6)
            return str(not self.options.local).lower() if known else "could not understand: 'is in remote control'"
        answers = {
            "PolyscopeVersion": f"URSoftware {major}.{minor}.0.1000 (Jan 01 2024)",
            "get serial number": "20245500001",
            "safetymode": f"Safetymode: {self.safety}",
            "robotmode": f"Robotmode: {self.options.mode}",
            "programState": "PLAYING other.urp" if self.runtime == PLAYING else "STOPPED <unnamed>",
            "stop": "Stopped",
        }
        return answers.get(line, f"could not understand: '{line}'")

    def gripper(self, line: str) -> bytes:
        """Robotiq's answer to a line."""
        verb, *words = line.split()
        with self.lock:
            if verb == "GET":
                return f"{words[0]} {self.jaws[words[0]]}\n".encode()
            wanted = {name: int(value) for name, value in zip(words[::2], words[1::2], strict=True)}
            self.jaws.update(wanted)
            if "ACT" in wanted:
                self.jaws["STA"] = 3 * wanted["ACT"]
            if wanted.get("GTO"):
                self._grip(wanted)
            return b"ack"

    def _grip(self, wanted: dict[str, int]) -> None:
        goal = self.jaws["POS"]
        self.log("jaws", **wanted)
        self.jaws["PRE"], self.jaws["OBJ"] = goal, 3
        if goal == 255:
            pattern = self.options.grasps
            if pattern[self.closes % len(pattern)] == "1":
                self.jaws["OBJ"], self.jaws["POS"] = 2, 105  # 50 mm of 85
            self.closes += 1


def rtde(controller: Controller, link: socket.socket) -> None:
    """One RTDE connection."""
    recipes: list[list[str]] = []
    outputs: list[str] = []
    sending = threading.Event()
    lock = threading.Lock()

    def reply(kind: str, payload: bytes) -> None:
        with lock:
            link.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def publish(period: float) -> None:
        while sending.is_set():
            values = b""
            with controller.lock:
                for name in outputs:
                    form, value = FORMATS[type_of(name)], controller.read(name)
                    values += struct.pack(">" + form, *(np.ravel(value).tolist()))  # type: ignore[call-overload]
            try:
                reply("U", b"\1" + values)
            except OSError:
                return
            time.sleep(period)

    frequency = 125.0
    try:
        while True:
            size, kind = struct.unpack(">HB", exactly(link, 3))
            body = exactly(link, size - 3)
            letter = chr(kind)
            if letter == "V":
                reply("V", b"\1")
            elif letter == "v":
                reply("v", struct.pack(">4I", *map(int, controller.options.version.split(".")), 0, 0))
            elif letter == "O":
                frequency = min(struct.unpack(">d", body[:8])[0], 125.0)
                outputs[:] = [name for name in body[8:].decode().split(",") if name]
                reply("O", b"\1" + ",".join(map(type_of, outputs)).encode())
            elif letter == "I":
                recipes.append([name for name in body.decode().split(",") if name])
                reply("I", bytes([len(recipes)]) + ",".join(map(type_of, recipes[-1])).encode())
            elif letter == "S":
                reply("S", b"\1")
                sending.set()
                threading.Thread(target=publish, args=(1 / frequency,), daemon=True).start()
            elif letter == "P":
                sending.clear()
                reply("P", b"\1")
            elif letter == "U":
                names = recipes[body[0] - 1]
                values = struct.unpack(">" + "".join(FORMATS[type_of(name)] for name in names), body[1:])
                controller.write(names, list(values))
    except OSError:
        sending.clear()


def exactly(link: socket.socket, count: int) -> bytes:
    """So many bytes."""
    data = b""
    while len(data) < count:
        more = link.recv(count - len(data))
        if not more:
            raise ConnectionError
        data += more
    return data


def lines(link: socket.socket, answer: Callable[[str], bytes], greeting: bytes = b"") -> None:
    """A line for a line."""
    with suppress(OSError):
        link.sendall(greeting)
        for line in link.makefile("r"):
            link.sendall(answer(line.strip()))


def scripts(controller: Controller, link: socket.socket) -> None:
    """Programs, each ended by a pause."""
    link.settimeout(0.1)
    text = b""
    while True:
        try:
            data = link.recv(65536)
            if not data:
                break
            text += data
        except TimeoutError:
            if text:
                controller.start(text.decode())
                text = b""
        except OSError:
            return
    if text:
        controller.start(text.decode())


def serve(host: str, port: int, handle: Callable[[socket.socket], None]) -> None:
    """Accept connections in a thread."""
    listener = socket.create_server((host, port))

    def accept() -> None:
        while True:
            link, _ = listener.accept()
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=handle, args=(link,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()


def main() -> None:
    """Serve until stdin is closed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.5")
    parser.add_argument("--log", required=True)
    parser.add_argument("--joints", required=True, help="[deg], separated by commas")
    parser.add_argument("--version", default="5.11")
    parser.add_argument("--mode", default="RUNNING")
    parser.add_argument("--local", action="store_true", help="not in remote control")
    parser.add_argument("--program", action="store_true", help="some program runs already")
    parser.add_argument("--motion", type=float, default=0.05, help="that every motion takes [s]")
    parser.add_argument("--grasps", default="01", help="what the jaws close on, over and over: nothing 0, a block 1")
    parser.add_argument("--stop_at", type=int, help="the motion during which a protective stop comes, from 1")
    parser.add_argument("--drop_at", type=int, help="the motion during which the controller vanishes, from 1")
    options = parser.parse_args()
    controller = Controller(options)
    serve(options.host, 30004, lambda link: rtde(controller, link))
    answer = lambda line: controller.dashboard(line).encode() + b"\n"  # noqa: E731
    serve(options.host, 29999, lambda link: lines(link, answer, b"Connected: Universal Robots Dashboard Server\n"))
    for port in (30001, 30002, 30003):
        serve(options.host, port, lambda link: scripts(controller, link))
    serve(options.host, 63352, lambda link: lines(link, controller.gripper))

    def run() -> None:
        while True:
            controller.tick()
            time.sleep(0.004)

    threading.Thread(target=run, daemon=True).start()
    print("ready", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
