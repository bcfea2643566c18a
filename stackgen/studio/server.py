"""The studio's web server: one page, and the endpoints that it and scripts use.

Endpoints only check what they are sent and hand the work to other processes (:mod:`stackgen.studio.workers`).
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Header, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.middleware import Middleware
from pydantic import BaseModel
from starlette.exceptions import HTTPException

from stackgen.errors import StackgenError, printable
from stackgen.studio.answers import Form, WorkResponse
from stackgen.studio.gallery import Gallery
from stackgen.studio.guard import OF_A_PAGE, OF_A_REPORT, Guard, refusal
from stackgen.studio.reference import reference_page
from stackgen.studio.requests import (
    ArmRequest,
    ExportRequest,
    GenerateRequest,
    PushRequest,
    ReadRequest,
    StackRequest,
    TiltRequest,
)
from stackgen.studio.work.methods import methods
from stackgen.studio.workers import Workers
from stackgen.viz.scene import shape_meshes
from stackgen.world import PAPER_WORLD

LOOPBACK = ("127.0.0.1", "localhost", "::1")

_PAGE = {
    "": ("index.html", "text/html"),
    "studio.js": ("studio.js", "text/javascript"),
    "studio.css": ("studio.css", "text/css"),
}


_MEDIA: dict[str, tuple[str, str | None]] = {
    "picture": ("image/png", None),
    "report": ("text/html", OF_A_REPORT),
    "page": ("text/html", OF_A_PAGE),
}
"""Media of the gallery's kinds that are not JSON, and what they may load."""


class Refusal(BaseModel):
    """What every answer with a status from 400 holds: one sentence."""

    detail: str


_REFUSALS: dict[int | str, dict[str, Any]] = {
    status: {"description": told, "model": Refusal}
    for status, told in {
        413: "The body is too large.",
        422: "The request cannot be answered; a sentence says why.",
        429: "Too many requests wait.",
    }.items()
}


def make_app(workers: Workers, gallery: Gallery, hosts: Iterable[str] = LOOPBACK) -> FastAPI:
    """Make the application.

    Args:
        workers: Processes that do the work; they are closed with the application.
        gallery: Results that it shows.
        hosts: Names by which it is reached.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        workers.open()
        yield
        workers.close()

    app = FastAPI(
        title="stackgen studio",
        description="Silhouettes to structures of blocks: what the page of `stackgen studio` asks, for scripts.",
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
        middleware=[Middleware(Guard, hosts=tuple(hosts))],
    )
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _not_there)
    _add_page(app)
    _add_gallery(app, gallery)
    for work in WORK:
        told: dict[str, Any] = {"summary": work.told, "responses": _REFUSALS, "status_code": 200}
        app.post(f"/api/{work.task}", response_class=WorkResponse, **told)(_endpoint(workers, work))
    return app


def _add_page(app: FastAPI) -> None:
    def serve(name: str, media: str) -> Any:
        return lambda: Response(_asset(name), media_type=media)

    for path, (name, media) in _PAGE.items():
        app.add_api_route(f"/{path}", serve(name, media), include_in_schema=False)

    @app.get("/api", include_in_schema=False)
    def reference() -> Response:
        return Response(reference_page(app.openapi()), media_type="text/html")

    @app.get("/api/start", summary="List the methods, and describe the shapes of the blocks.")
    def start() -> dict[str, Any]:
        return {
            "methods": methods(),
            "shapes": shape_meshes(PAPER_WORLD.catalogue),
            "most_blocks": PAPER_WORLD.max_blocks,
        }


def _add_gallery(app: FastAPI, gallery: Gallery) -> None:
    @app.get("/api/gallery", summary="List the results on this machine: stacks files, pictures, tables and reports.")
    def listing() -> list[dict[str, str]]:
        return [item.to_json() for item in gallery.items()]

    @app.get("/api/gallery/{item}", summary="Read a result that was listed.", responses=_REFUSALS)
    def content(item: Annotated[str, Path(pattern="^[0-9a-f]{16}$")]) -> Response:
        try:
            kind, found = gallery.content(item)
        except StackgenError as error:
            return refusal(404, printable(error))
        media, policy = _MEDIA.get(kind, ("application/json", None))
        return Response(found, media_type=media, headers={"Content-Security-Policy": policy} if policy else None)


@dataclass(frozen=True)
class Work:
    """An endpoint that has work done.

    Args:
        task: Name of the task, and of the endpoint.
        request: What it is sent.
        told: What it does, in a sentence.
        form: Form of the answer.
    """

    task: str
    request: type[BaseModel]
    told: str
    form: Form = "json"


WORK = (
    Work(
        "generate", GenerateRequest, "Make stacks for a drawing; the answer has a message a line, as it goes.", "lines"
    ),
    Work("read", ReadRequest, "Read a picture, and turn what is in it into a drawing."),
    Work("check", StackRequest, "Simulate a stack, and say whether it stands and why."),
    Work("tilt", TiltRequest, "Tilt the table under a stack slowly, and find the angle at which a block falls."),
    Work("push", PushRequest, "Push a block harder and harder, and find the force at which one falls."),
    Work("order", StackRequest, "Find the order in which a stack can be built."),
    Work("build", StackRequest, "Have the simulated arm build a stack; the answer has a message a line.", "lines"),
    Work("arm", ArmRequest, "Describe the arm: its links, joints and meshes."),
    Work("export", ExportRequest, "Make a file of a stack: GLB or MP4.", "file"),
)


def _client(
    request: Request,
    name: Annotated[
        str, Header(alias="X-Client", max_length=40, pattern="^[0-9a-zA-Z-]*$", include_in_schema=False)
    ] = "",
) -> str:
    """Tell the pages and scripts apart that share the processes."""
    return name or (request.client.host if request.client else "")


def _endpoint(workers: Workers, work: Work) -> Callable[..., Awaitable[Response]]:
    async def answer(body: Any, client: Any) -> Response:
        return WorkResponse(workers.work(client, work.task, body), work.form)

    answer.__annotations__ = {"body": work.request, "client": Annotated[str, Depends(_client)]}
    return answer


@cache
def _asset(name: str) -> bytes:
    return files("stackgen").joinpath("assets/studio", name).read_bytes()


async def _invalid(request: Request, error: Exception) -> Response:
    """Say in one sentence what is wrong with a request, and where."""
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"] if part != "body") or "the body"
    return refusal(422, printable(f"{place}: {first['msg']}")[:300])


async def _not_there(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return refusal(error.status_code, printable(str(error.detail)))
