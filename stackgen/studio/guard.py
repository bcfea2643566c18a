"""Who may ask the studio, how much, and what its pages may load: checked before anything else is done.

Only the studio's own page drives it: a request names one of its hosts, and comes from no other origin. There is no
WebSocket. A page may load what the studio itself serves, and nothing else.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from typing import Any
from urllib.parse import urlsplit

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BYTES = 9_000_000
"""Largest body of a request."""

_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self';"
    " img-src 'self' data: blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}


def refusal(status: int, sentence: str) -> Response:
    """Answer that a request was not right, in one sentence."""
    return Response(json.dumps({"detail": sentence}), status, media_type="application/json")


class TooLarge(Exception):
    """A body went on beyond the limit."""


class Guard:
    """An ASGI application in front of another.

    Args:
        app: Application behind it.
        hosts: Names by which the studio is reached, without ports.
    """

    def __init__(self, app: ASGIApp, hosts: Iterable[str]) -> None:
        self.app, self.hosts = app, frozenset(host.lower() for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ASGI."""
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})
            return
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        answer = self._refusal({name.lower(): value for name, value in scope["headers"]})
        if answer is not None:
            await answer(scope, receive, _with_headers(send))
            return
        body = _Body(receive)
        with contextlib.suppress(TooLarge):
            await self.app(scope, body.receive, _with_headers(body.unless_too_large(send)))
        if body.too_large:
            await refusal(413, _TOO_LARGE)(scope, receive, _with_headers(send))

    def _refusal(self, headers: dict[bytes, bytes]) -> Response | None:
        host = headers.get(b"host", b"").decode("latin-1")
        if self._name(f"//{host}") not in self.hosts:
            return refusal(421, "this address is not one of the studio's: open the one that it printed")
        origin = headers.get(b"origin")
        foreign = origin is not None and origin.decode("latin-1").partition("://")[2] != host
        if foreign or headers.get(b"sec-fetch-site", b"none") not in (b"none", b"same-origin"):
            return refusal(403, "another site may not use the studio")
        length = headers.get(b"content-length", b"0")
        if not length.isdigit() or int(length) > MOST_BYTES:
            return refusal(413, _TOO_LARGE)
        return None

    @staticmethod
    def _name(address: str) -> str | None:
        try:
            return urlsplit(address).hostname
        except ValueError:
            return None


_TOO_LARGE = f"the request is too large: at most {MOST_BYTES // 1_000_000} MB are taken, so scale the picture down"


class _Body:
    """A body that is received up to the limit, whatever its header says."""

    def __init__(self, receive: Receive) -> None:
        self._receive, self._received = receive, 0

    @property
    def too_large(self) -> bool:
        """Whether there was more than the limit."""
        return self._received > MOST_BYTES

    async def receive(self) -> Message:
        """See ASGI."""
        message = await self._receive()
        self._received += len(message.get("body", b""))
        if self.too_large:
            raise TooLarge
        return message

    def unless_too_large(self, send: Send) -> Send:
        """Send on what the application answers, unless it only answers that the body broke off."""

        async def sending(message: Message) -> None:
            if not self.too_large:
                await send(message)

        return sending


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            own: list[Any] = [(name.lower().encode(), value.encode()) for name, value in _HEADERS.items()]
            message = {**message, "headers": [*message.get("headers", []), *own]}
        await send(message)

    return sending
