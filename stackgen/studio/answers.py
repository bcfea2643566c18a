"""Answers of the studio that take a while: work of another process, whose messages are sent on as they come.

Closing the connection cancels the work.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import logging
from collections.abc import AsyncGenerator
from typing import Literal

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from stackgen.studio.guard import refusal
from stackgen.studio.workers import Broken, Busy, Refused

Form = Literal["lines", "json", "file"]
"""All messages, a line each; the last one alone; or the file in it."""

LINES = "application/x-ndjson"

_BUG = "this is a bug of the studio; what it was doing is in its log"


class WorkResponse(Response):
    """Messages of some work.

    Args:
        messages: JSON of each.
        form: Form in which they are sent.
    """

    def __init__(self, messages: AsyncGenerator[bytes, None], form: Form = "json") -> None:
        super().__init__()
        self.messages, self.form = messages, form
        self.begun = False

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ASGI."""
        gone = asyncio.create_task(_gone(receive))
        work = asyncio.create_task(self._answer(scope, receive, send))
        try:
            await asyncio.wait({gone, work}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            gone.cancel()
            work.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await work

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            async with contextlib.aclosing(self.messages) as messages:
                await (self._lines if self.form == "lines" else self._last)(messages, send)
        except (Refused, Busy, Broken) as error:
            status, sentence = _told(error)
            if self.begun:
                line = json.dumps({"kind": "error", "detail": sentence}).encode() + b"\n"
                await send({"type": "http.response.body", "body": line})
            else:
                await refusal(status, sentence)(scope, receive, send)

    async def _lines(self, messages: AsyncGenerator[bytes, None], send: Send) -> None:
        """Send each message as it comes; the first one decides that there is an answer."""
        async for message in messages:
            if not self.begun:
                await send(_start(LINES))
                self.begun = True
            await send({"type": "http.response.body", "body": message + b"\n", "more_body": True})
        await send({"type": "http.response.body", "body": b""})

    async def _last(self, messages: AsyncGenerator[bytes, None], send: Send) -> None:
        """Send the last message, or the file in it."""
        content, media = [message async for message in messages][-1], "application/json"
        if self.form == "file":
            file = json.loads(content)
            content, media = base64.b64decode(file["content"]), file["media"]
        await send(_start(media))
        await send({"type": "http.response.body", "body": content})


def _told(error: Exception) -> tuple[int, str]:
    if isinstance(error, Busy):
        return 429, str(error)
    if isinstance(error, Refused):
        return 422, str(error)
    logging.getLogger("stackgen.studio").error("%s", error)
    return 500, _BUG


def _start(media: str) -> dict[str, object]:
    return {"type": "http.response.start", "status": 200, "headers": [(b"content-type", media.encode())]}


async def _gone(receive: Receive) -> None:
    """Wait until nobody listens any more."""
    while (await receive())["type"] != "http.disconnect":
        pass
