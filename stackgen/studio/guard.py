"""Who may ask the studio, how much, and what its pages may load: checked before anything else is done.

Only the studio's own page drives it: a request names one of its hosts, and comes from no other origin. There is no
WebSocket. A page may load what the studio itself serves, and nothing else.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BYTES = 9_000_000
"""Largest body of a request."""

_NOTHING = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; "

_HEADERS = {
    b"content-security-policy": f"{_NOTHING}script-src 'self'; style-src 'self'; connect-src 'self';"
    " img-src 'self' data: blob:".encode(),
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"referrer-policy": b"no-referrer",
    b"x-content-type-options": b"nosniff",
    b"cache-control": b"no-cache",
}
"""Headers of an answer that has not its own."""

OF_A_REPORT = f"{_NOTHING}style-src 'self'; img-src 'self' data:"
"""What a report of the gallery may load: no script runs in it."""

OF_A_PAGE = (
    f"{_NOTHING}sandbox allow-scripts; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)
"""What somebody's HTML may do: run by itself, as of another origin, which the studio does not let in."""


def refusal(status: int, sentence: str) -> Response:
    """Answer that a request was not right, in one sentence."""
    return Response(json.dumps({"detail": sentence}), status, media_type="application/json")


class TooLarge(Exception):
    """A body went on beyond the limit."""


class Guard:
    """An ASGI application in front of another.

    Args:
        app: Application behind it.
        hosts: Names by which the studio is reached, without ports; 0.0.0.0 or :: for any address of this machine,
            which no other site can make its own name for.
    """

    def __init__(self, app: ASGIApp, hosts: Iterable[str]) -> None:
        self.app, self.hosts = app, frozenset(host.lower() for host in hosts)
        self.any_address = not self.hosts.isdisjoint({"0.0.0.0", "::"})

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
        name = self._name(f"//{host}")
        if name not in self.hosts and not (self.any_address and _is_address(name)):
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


def _is_address(name: str | None) -> bool:
    """Tell whether a host is a number, not a name."""
    try:
        ip_address(name or "")
    except ValueError:
        return False
    return True


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
            own = dict(message.get("headers", []))
            message = {**message, "headers": [*own.items(), *((k, v) for k, v in _HEADERS.items() if k not in own)]}
        await send(message)

    return sending
