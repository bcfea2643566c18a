"""Lines over a socket from a machine that may say anything: bounded in time and size, and printable."""

from __future__ import annotations

import socket
import time

from stackgen.errors import printable

_LONGEST = 1000
"""Characters of an answer, at most; those of controllers have fewer than a hundred."""


class LineLink:
    """A connection on which each line that is sent is answered by one.

    Args:
        host: Address of the machine.
        port: Port of the server.
        patience: Time for the connection, and for each answer as a whole [s].

    Raises:
        OSError: If nobody answers.
    """

    def __init__(self, host: str, port: int, patience: float) -> None:
        self._patience, self._rest = patience, b""
        self._socket = socket.create_connection((host, port), timeout=patience)

    def ask(self, line: str, prefixes: tuple[bytes, ...] = ()) -> str:
        """Send a line and read the answer.

        Args:
            line: What is sent, without its end.
            prefixes: Answers that come without the end of a line.

        Raises:
            OSError: If no whole answer comes in time, or one that is too long.
        """
        self._socket.settimeout(self._patience)
        self._socket.sendall(line.encode() + b"\n")
        return self.read(prefixes)

    def read(self, prefixes: tuple[bytes, ...] = ()) -> str:
        """Read one line; see :meth:`ask`."""
        end = time.monotonic() + self._patience
        while True:
            self._rest = self._rest.lstrip(b"\r\n") if prefixes else self._rest
            for prefix in prefixes:
                if self._rest.startswith(prefix):
                    self._rest = self._rest[len(prefix) :]
                    return prefix.decode()
            if b"\n" in self._rest:
                answer, _, self._rest = self._rest.partition(b"\n")
                return printable(answer.decode("utf-8", "backslashreplace").strip())
            if len(self._rest) > _LONGEST:
                raise ConnectionError("its answer has no end")
            left = end - time.monotonic()
            if left <= 0:
                raise TimeoutError(f"no whole answer within {self._patience:g} s")
            self._socket.settimeout(left)
            data = self._socket.recv(_LONGEST)
            if not data:
                raise ConnectionError("it closed the connection")
            self._rest += data

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
