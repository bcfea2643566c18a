"""Runs the studio until it is told to end."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable
from pathlib import Path

import uvicorn

from stackgen.errors import StackgenError
from stackgen.studio.gallery import Gallery
from stackgen.studio.server import LOOPBACK, make_app
from stackgen.studio.workers import Workers


def serve(host: str, port: int, workers: int, gallery: Path, ready: Callable[[str], None]) -> None:
    """Serve the studio.

    Args:
        host: Address to listen at.
        port: Port; 0 for any that is free.
        workers: Number of processes that work.
        gallery: Folder whose results are shown.
        ready: Called with the address once it can be opened.

    Raises:
        StackgenError: If the port cannot be listened at.
    """
    listening = _listen(host, port)
    shown = f"[{host}]" if ":" in host else host
    app = make_app(Workers(workers), Gallery(gallery), (*LOOPBACK, host))
    config = uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=1, ws="none")
    ready(f"http://{shown}:{listening.getsockname()[1]}/")
    server = uvicorn.Server(config)
    logging.getLogger("uvicorn.error").addFilter(lambda record: not server.should_exit)  # what the end cuts off
    server.run(sockets=[listening])


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, protocol)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        raise StackgenError(
            f"--host {host} --port {port}: cannot be listened at ({error.strerror or error}); give another --port"
        ) from None
    return listening
