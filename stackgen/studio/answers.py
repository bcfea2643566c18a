"""Answers of the studio that take a while: work of another process, whose messages are sent on as they come.

Whoever closes the connection cancels the work.
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

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ASGI."""
        gone = asyncio.create_task(_gone(receive))
        work = asyncio.create_task(self._answer(scope, receive, send))
        await asyncio.wait({gone, work}, return_when=asyncio.FIRST_COMPLETED)
        for task in (gone, work):
            if not task.done():
                task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await work

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        begun = False
        try:
            async with contextlib.aclosing(self.messages) as messages:
                last = b"{}"
                async for last in messages:
                    if self.form == "lines":
                        if not begun:
                            await send(_start(LINES))
                            begun = True
                        await send({"type": "http.response.body", "body": last + b"\n", "more_body": True})
        except (Refused, Busy, Broken) as error:
            status, sentence = _told(error)
            if not begun:
                await refusal(status, sentence)(scope, receive, send)
                return
            last = json.dumps({"kind": "error", "detail": sentence}).encode() + b"\n"
            await send({"type": "http.response.body", "body": last})
            return
        if self.form != "lines":
            await send(_start("application/json" if self.form == "json" else json.loads(last)["media"]))
        body = {
            "lines": lambda: b"",
            "json": lambda: last,
            "file": lambda: base64.b64decode(json.loads(last)["content"]),
        }
        await send({"type": "http.response.body", "body": body[self.form]()})


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
