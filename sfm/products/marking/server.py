"""The server of the marking page: on this computer only, under an address with a secret.

A request needs the secret in its path, and the host and port of this server, so that no other page or user
of the computer gets an answer. A request that changes something is a POST of JSON with the secret in a
header, which pages of other sites cannot send. Everything else is refused. Nothing is written but the marks
file and the survey.

Source: OWASP Cheat Sheet Series, Cross-Site Request Forgery Prevention; Jackson et al., Protecting Browsers
from DNS Rebinding Attacks (2007).
"""

from __future__ import annotations

import hmac
import math
import os
import secrets
import socket
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import uvicorn
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from sfm.files.plain_text import MAX_NAME
from sfm.model.errors import KolinearError, OutputError
from sfm.products.marking.session import MarkingSession
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import Kind, StatedPoint

HOST = "127.0.0.1"
HEADER = "x-kolinear"  # carries the secret in requests that change something
PAGE = Path(__file__).with_name("page")
FILES = {
    "": ("mark.html", "text/html"),
    "mark.js": ("mark.js", "text/javascript"),
    "mark.css": ("mark.css", "text/css"),
}
MAX_BODY = 100_000  # bytes of a request
POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
SAFE = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
OF_REPORT = {**SAFE, "Content-Security-Policy": "frame-ancestors 'none'"}  # pages of reports state their own
KEPT = {"Cache-Control": "private, max-age=3600"}  # of tiles, which do not change
Name = Annotated[str, Field(min_length=1, max_length=MAX_NAME)]
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Sigma = Annotated[float, Field(ge=0, le=1e12)]
Positive = Annotated[float, Field(ge=1e-9, le=1e12)]
Index = Annotated[int, Field(ge=0, le=1_000_000)]
Version = Annotated[int, Field(ge=0, le=10**15)]
Answer = Callable[[Request], Awaitable[Response]]


class Body(BaseModel):
    """What a request states; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    page: Annotated[str, Field(max_length=MAX_NAME)] = ""  # which page asks, a name that it chose itself


class Click(Body):
    """A click in a photograph."""

    image: Index
    x: Number
    y: Number
    point: Name | None = None
    kind: Kind | None = None
    sigma_px: Positive | None = None


class Chosen(Body):
    """A point in a photograph, a point, or everything, as the page shows it."""

    image: Index | None = None
    point: Name | None = None
    version: Version  # of the state that the person looked at


class Deleted(Body):
    """A point in a photograph, or a point."""

    point: Name
    image: Index | None = None


class Renamed(Body):
    """A point and its new name."""

    point: Name
    name: Name


class Control(Body):
    """Stated coordinates of a point, object unit."""

    point: Name
    X: Number = 0.0
    Y: Number = 0.0
    Z: Number = 0.0
    sigma: tuple[Sigma, Sigma, Sigma] = (0.0, 0.0, 0.0)
    remove: bool = False

    @property
    def stated(self) -> StatedPoint | None:
        """The control point; None removes it."""
        return None if self.remove else StatedPoint((self.X, self.Y, self.Z), self.sigma)


class Bar(Body):
    """Stated distance of two points, object unit."""

    start: Name
    end: Name
    length: Positive = 1.0
    sigma: Positive = 1.0
    remove: bool = False

    @property
    def stated(self) -> ScaleBar | None:
        """The scale bar; None removes it."""
        return None if self.remove else ScaleBar(self.start, self.end, self.length, self.sigma)


class Step(Body):
    """The change that is undone or made again."""

    number: Version
    anyway: bool = False  # also if another page made it


class Nothing(Body):
    """A request without content."""


CHANGES: dict[str, tuple[type[Body], Callable[[MarkingSession, Any], dict[str, Any]]]] = {
    "click": (
        Click,
        lambda session, b: session.click(
            b.image, b.x, b.y, point=b.point, kind=b.kind, sigma_px=b.sigma_px, page=b.page
        ),
    ),
    "accept": (Chosen, lambda session, b: session.accept(b.image, b.point, seen=b.version, page=b.page)),
    "refuse": (Chosen, lambda session, b: session.refuse(b.image, b.point, seen=b.version, page=b.page)),
    "delete": (Deleted, lambda session, b: session.delete(b.point, b.image, page=b.page)),
    "rename": (Renamed, lambda session, b: session.rename(b.point, b.name, page=b.page)),
    "control": (Control, lambda session, b: session.set_control(b.point, b.stated, page=b.page)),
    "bar": (Bar, lambda session, b: session.set_bar(b.start, b.end, b.stated, page=b.page)),
    "automatic": (Nothing, lambda session, b: session.automatic()),
    "undo": (Step, lambda session, b: session.undo(b.number, page=b.page, anyway=b.anyway)),
    "redo": (Step, lambda session, b: session.redo(b.number, page=b.page, anyway=b.anyway)),
}


@dataclass(frozen=True)
class Address:
    """Where the server listens."""

    port: int
    secret: str

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{HOST}:{self.port}/{self.secret}/"

    @property
    def hosts(self) -> tuple[str, str]:
        """What a browser may state as host."""
        return f"{HOST}:{self.port}", f"localhost:{self.port}"


@dataclass(frozen=True)
class Guard:
    """What a request must have, before anything else is read from it."""

    address: Address

    def refusal(self, request: Request) -> Response | None:
        """Return the answer to a request that is refused."""
        host = request.headers.get("host", "")
        if host not in self.address.hosts:
            return _refused(403)
        if not self._is_secret(request.path_params.get("secret", "")):
            return _refused(404)
        if request.headers.get("origin", f"http://{host}") != f"http://{host}":
            return _refused(403)
        if request.headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return _refused(403)
        if request.method == "POST":
            kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
            if kind != "application/json" or not self._is_secret(request.headers.get(HEADER, "")):
                return _refused(403)
        return None

    def _is_secret(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self.address.secret.encode())

    def guarded(self, answer: Answer) -> Answer:
        """Return a function that answers only what is not refused, and says why a request cannot be done."""

        async def guarded_answer(request: Request) -> Response:
            refused = self.refusal(request)
            if refused is not None:
                return refused
            try:
                return await answer(request)
            except KolinearError as error:
                return _json({"error": str(error)}, 422)

        return guarded_answer


@dataclass(frozen=True)
class Answers:
    """The answers of a session to requests."""

    session: MarkingSession

    async def page(self, request: Request) -> Response:
        """Return the page, its script or its style sheet."""
        name, kind = FILES.get(request.path_params.get("file", ""), ("", ""))
        if not name:
            return _refused(404)
        return Response((PAGE / name).read_bytes(), media_type=f"{kind}; charset=utf-8", headers=SAFE)

    async def state(self, request: Request) -> Response:
        """Return the state, newer than a version if one is stated."""
        after = request.query_params.get("after", "")
        version = int(after) if after.isascii() and after.isdecimal() and len(after) < 16 else None
        return _json(await run_in_threadpool(self.session.state, version))

    async def descriptor(self, request: Request) -> Response:
        """Return the DZI descriptor of a photograph."""
        i = request.path_params["image"]
        if i >= len(self.session.project.photographs):
            return _refused(404)
        return Response(self.session.pixels.descriptor(i), media_type="application/xml", headers=SAFE)

    async def tile(self, request: Request) -> Response:
        """Return a tile of a photograph."""
        at = request.path_params
        data = await run_in_threadpool(
            self.session.pixels.tile, at["image"], at["level"], at["column"], at["row"]
        )
        if data is None:
            return _refused(404)
        return Response(data, media_type="image/jpeg", headers={**SAFE, **KEPT})

    async def fit(self, request: Request) -> Response:
        """Return the picture of the fit of a mark."""
        at = request.path_params
        data = await run_in_threadpool(self.session.fit_picture, at["image"], at["point"])
        return _refused(404) if data is None else Response(data, media_type="image/png", headers=SAFE)

    async def report(self, request: Request) -> Response:
        """Return a file of the report."""
        path = await run_in_threadpool(self.session.report_file, request.path_params["path"])
        return _refused(404) if path is None else FileResponse(path, headers=OF_REPORT)

    async def sight(self, request: Request) -> Response:
        """Return a ray of sight in the other photographs."""
        try:
            image = int(request.query_params["image"])
            x, y = (float(request.query_params[name]) for name in ("x", "y"))
        except (KeyError, ValueError):
            return _refused(422)
        if not (math.isfinite(x) and math.isfinite(y)):
            return _refused(422)
        return _json({"lines": await run_in_threadpool(self.session.sight, image, x, y)})

    async def change(self, request: Request) -> Response:
        """Do what a request asks for, and return what became of it."""
        row = CHANGES.get(request.path_params["change"])
        if row is None:
            return _refused(404)
        data = bytearray()
        async for chunk in request.stream():
            data += chunk
            if len(data) > MAX_BODY:
                return _json({"error": f"a request of more than {MAX_BODY} bytes"}, 413)
        kind, change_session = row
        try:
            body = kind.model_validate_json(bytes(data) or b"{}")
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            return _json({"error": f"{where}: {first['msg']}"[:300]}, 422)
        return _json(await run_in_threadpool(change_session, self.session, body))


def application(session: MarkingSession, address: Address) -> Starlette:
    """Return the application.

    Args:
        session: the session that answers.
        address: port and secret.
    """
    answers, guarded = Answers(session), Guard(address).guarded
    routes = [
        Route("/{secret}/", guarded(answers.page)),
        Route("/{secret}/state", guarded(answers.state)),
        Route("/{secret}/sight", guarded(answers.sight)),
        Route("/{secret}/{file:str}", guarded(answers.page)),
        Route("/{secret}/tiles/{image:int}.dzi", guarded(answers.descriptor)),
        Route(
            "/{secret}/tiles/{image:int}_files/{level:int}/{column:int}_{row:int}.jpg", guarded(answers.tile)
        ),
        Route("/{secret}/fit/{image:int}/{point:path}.png", guarded(answers.fit)),
        Route("/{secret}/report/{path:path}", guarded(answers.report)),
        Route("/{secret}/{change:str}", guarded(answers.change), methods=["POST"]),
    ]
    made = Starlette(routes=routes, exception_handlers={404: _not_there, 405: _not_there, 500: _failed})
    made.router.redirect_slashes = False  # it would answer before the secret is compared
    return made


def _json(content: dict[str, Any], status: int = 200) -> JSONResponse:
    try:
        return JSONResponse(content, status, headers=SAFE)
    except ValueError:  # JSON has no word for what is not finite
        return JSONResponse(_finite(content), status, headers=SAFE)


def _finite(value: Any) -> Any:
    """Return JSON content with None for what is not finite."""
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _refused(status: int) -> Response:
    return Response(status_code=status, headers=SAFE)


async def _not_there(request: Request, error: Exception) -> Response:
    return _refused(404)


async def _failed(request: Request, error: Exception) -> Response:
    return _json({"error": f"the server failed: {type(error).__name__}"}, 500)


class MarkingServer:
    """The page of a session, served until it is stopped."""

    def __init__(self, session: MarkingSession, port: int = 0) -> None:
        """Listen on a port of this computer.

        Args:
            session: the session that answers.
            port: the port; 0 for any free one.

        Raises:
            OutputError: another program has the port.
        """
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        if os.name == "posix":  # a port whose last server has just ended; elsewhere it would share the port
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self.socket.bind((HOST, port))
            self.socket.listen()
        except OSError as error:
            self.socket.close()
            raise OutputError(
                f"port {port}: another program has it ({error.strerror}); leave --port out for a free one"
            ) from error
        self.session = session
        self.address = Address(self.socket.getsockname()[1], secrets.token_urlsafe(24))
        config = uvicorn.Config(
            application(session, self.address),
            log_level="warning",
            access_log=False,
            lifespan="off",
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)

    def serve(self) -> None:
        """Answer requests until `stop` or Ctrl-C."""
        try:
            self._server.run(sockets=[self.socket])
        finally:
            self.socket.close()

    def stop(self) -> None:
        """End `serve`."""
        self._server.should_exit = True
