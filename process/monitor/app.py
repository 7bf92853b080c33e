"""The monitor's routes: page, status, thumbnails, metrics, and start and stop where they are allowed."""

import json
import time
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from capture.errors import CaptureError
from capture.health import Health, Notice, Verdict, judge, read_health
from process.monitor.control import Control
from process.monitor.gallery import Gallery
from process.monitor.guard import BodyTooLarge
from process.monitor.metrics import CONTENT_TYPE, metrics_text, ptp_offset_ns

_FRESH_S = 0.1  # health is read at most so often, however many ask
_PAGE = {
    "": ("index.html", "text/html; charset=utf-8"),
    "icon.svg": ("icon.svg", "image/svg+xml"),
    "monitor.css": ("monitor.css", "text/css; charset=utf-8"),
    "monitor.js": ("monitor.js", "text/javascript; charset=utf-8"),
}
ACTIONS = ("start", "stop")


class Status:
    """Health, verdict and pictures as they are now; read once for all who ask at the same time."""

    def __init__(self, folder: Path, gallery: Gallery, control: Control) -> None:
        self.control = control
        self._folder = folder
        self._gallery = gallery
        self._read_s = float("-inf")
        self._now: tuple[Health | None, Verdict] = (None, judge(None, 0.0))

    def health(self) -> tuple[Health | None, Verdict]:
        """The latest snapshot and what it is worth."""
        now_s = time.monotonic()
        if now_s - self._read_s > _FRESH_S:
            try:
                health = read_health(self._folder)
                self._now = health, judge(health, now_s)
            except CaptureError as error:
                self._now = None, Verdict((Notice(3, "recorder", str(error)),), (), None)
            self._read_s = now_s
        return self._now

    def picture_figures(self) -> dict[str, dict[str, Any]]:
        """By place."""
        now_s = time.monotonic()
        return {place: picture.figures(now_s) for place, picture in self._gallery.pictures().items()}

    def jpeg(self, place: str) -> bytes | None:
        """A camera's thumbnail."""
        picture = self._gallery.pictures().get(place)
        return None if picture is None else picture.jpeg

    def as_dict(self) -> dict[str, Any]:
        """All that the page shows."""
        health, verdict = self.health()
        return {
            "go": verdict.go,
            "reasons": [_plain(notice) for notice in verdict.reasons],
            "cautions": [_plain(notice) for notice in verdict.cautions],
            "age_s": None if verdict.age_s is None else round(verdict.age_s, 2),
            "health": None if health is None else health.as_dict(),
            "ptp_offset_ns": None if health is None else ptp_offset_ns(health),
            "pictures": self.picture_figures(),
            "control": {"refusal": self.control.refusal(health)},
        }


def make_app(status: Status) -> Starlette:
    """The application, unguarded."""
    page = {
        name: (files("process.monitor").joinpath("page", file).read_bytes(), kind)
        for name, (file, kind) in _PAGE.items()
    }

    def shown(name: str) -> Callable[[Request], Any]:
        async def show(_: Request) -> Response:
            body, kind = page[name]
            return Response(body, media_type=kind)

        return show

    async def status_json(_: Request) -> Response:
        return Response(json.dumps(status.as_dict()), media_type="application/json")

    async def thumbnail(request: Request) -> Response:
        jpeg = status.jpeg(f"{request.path_params['side']}/{request.path_params['camera']}")
        if jpeg is None:
            raise HTTPException(404)
        return Response(jpeg, media_type="image/jpeg")

    async def metrics(_: Request) -> Response:
        return Response(
            metrics_text(*status.health(), status.picture_figures()), headers={"content-type": CONTENT_TYPE}
        )

    async def act(request: Request) -> Response:
        return await _act(status, request)

    routes = [Route(f"/{name}", shown(name), methods=["GET"]) for name in page]
    routes += [
        Route("/api/status", status_json, methods=["GET"]),
        Route("/api/thumbnail/{side}/{camera}", thumbnail, methods=["GET"]),
        Route("/api/control", act, methods=["POST"]),
        Route("/metrics", metrics, methods=["GET"]),
    ]
    return Starlette(routes=routes, exception_handlers={HTTPException: _plain_error, BodyTooLarge: _too_large})


async def _act(status: Status, request: Request) -> Response:
    """Start or stop. Only from our own page: a form or a script of another site cannot send this content type and
    header without the browser asking us first, which we do not answer."""
    if request.headers.get("content-type") != "application/json" or request.headers.get("x-wingshape") != "monitor":
        raise HTTPException(415)
    try:
        asked = json.loads(await request.body())
        action, flight = asked["action"], asked["flight"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise HTTPException(400) from error
    if action not in ACTIONS or not isinstance(flight, str):
        raise HTTPException(400)
    health, _ = status.health()
    refusal = status.control.refusal(health)
    if refusal is None and health is not None and health.flight != flight:
        refusal = f"the flight is {health.flight} by now, not {flight}: look again"
    if refusal is not None or health is None:
        return _answer(409, refusal or "no recorder")
    try:
        return _answer(200, await run_in_threadpool(status.control.act, health, action))
    except CaptureError as error:
        return _answer(502, str(error))


def _answer(status: int, message: str) -> Response:
    return Response(json.dumps({"message": message}), status, media_type="application/json")


async def _plain_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return Response(status_code=error.status_code, headers=error.headers)


async def _too_large(_: Request, _error: Exception) -> Response:
    return Response(status_code=413, headers={"connection": "close"})


def _plain(notice: Notice) -> dict[str, str]:
    return {"name": notice.name, "message": notice.message}
