"""Connections to PyBullet: its functions without naming the connection each time, and their end with a context."""

from __future__ import annotations

from functools import partial
from types import TracebackType
from typing import Any, Self

from stackgen.sim.bullet_engine import bullet


class Bullet:
    """The functions of PyBullet on one connection.

    Args:
        number: PyBullet's number of the connection.
    """

    def __init__(self, number: int) -> None:
        self.number = number

    def __getattr__(self, name: str) -> Any:
        return partial(getattr(bullet, name), physicsClientId=self.number)


class Connected:
    """What holds a connection to PyBullet; on leaving the context it is closed.

    Args:
        client: PyBullet's number of the connection.
    """

    def __init__(self, client: int) -> None:
        self.client, self.bullet = client, Bullet(client)

    def disconnect(self) -> None:
        """Close the connection, if it is open, and free its memory."""
        if self.client >= 0 and bullet.isConnected(self.client):
            bullet.disconnect(self.client)
        self.client = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.disconnect()
