"""The page's server: history -> HTTP and server-sent events. docs/monitor.md lists the addresses.

Everything is read from a `FrameStore`, so that the live page, the slider and a recording are the same. Store calls
block and run in worker threads.
"""

from __future__ import annotations

import getpass
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from meshctl.errors import InputError, MeshctlError
from meshctl.monitor.access import AccessControl, AccessRules, error_response
from meshctl.monitor.actions import Actions
from meshctl.monitor.alarm_log import Silence
from meshctl.monitor.event_stream import EventStreams
from meshctl.monitor.feed import Feed
from meshctl.monitor.frame import Frame
from meshctl.monitor.history_file import ANY
from meshctl.monitor.page import ASSETS
from meshctl.monitor.series import charts_of
from meshctl.monitor.store import FrameStore
from meshctl.status.alarm_codes import CODES

MAX_FRAMES = 500
MAX_BUCKETS = 2000
# Points in a chart: about one per pixel of a side panel.
CHART_POINTS = 300
MAX_BODY_BYTES = 16_384
MAX_SILENCE_S = 366 * 86400.0


@dataclass(frozen=True, slots=True)
class PageSettings:
    """Settings that the page requests once. `topic_classes` maps topic names to their classes in the inventory;
    `has_report`: there are tables and charts of udp-mesh's recordings."""

    fleet: str
    version: str
    mode: str = "live"
    interval_s: float = 5.0
    topic_classes: Mapping[str, str] = field(default_factory=dict)
    has_report: bool = False

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "topic_classes": dict(self.topic_classes)}


class BadRequest(Exception):
    """A parameter or a body that is not valid."""


@dataclass(frozen=True, slots=True)
class MonitorServer:
    """The routes over one history. `metrics` renders /metrics; `clock` is Unix time; `report` are the documents of
    udp-mesh's recordings."""

    store: FrameStore
    feed: Feed
    settings: PageSettings
    rules: AccessRules = field(default_factory=AccessRules)
    actions: Actions | None = None
    metrics: Callable[[Frame | None, FrameStore, float], str] | None = None
    clock: Callable[[], float] = time.time
    report: Sequence[Mapping[str, Any]] = ()
    streams: EventStreams = field(init=False)

    def __post_init__(self) -> None:
        streams = EventStreams(self.store, self.feed, self.clock, is_live=self.settings.mode == "live")
        object.__setattr__(self, "streams", streams)

    def app(self) -> Starlette:
        routes = [
            Route("/", self._page),
            Mount("/assets", StaticFiles(directory=ASSETS)),
            Route("/api/meta", self._meta),
            Route("/api/frame", self._frame),
            Route("/api/frames", self._frames),
            Route("/api/timeline", self._timeline),
            Route("/api/series", self._series),
            Route("/api/events", self._events),
            Route("/api/report", self._report),
            Route("/api/alarms", self._alarms),
            Route("/api/alarms/ack", self._acknowledge, methods=["POST"]),
            Route("/api/alarms/silence", self._silence, methods=["POST"]),
            Route("/metrics", self._metrics),
        ]
        if self.actions is not None:
            routes.append(Route("/api/actions/{action}", self._action, methods=["POST"]))
        return Starlette(
            routes=routes,
            middleware=[
                Middleware(AccessControl, rules=self.rules),
                # leaves event streams as they are
                Middleware(GZipMiddleware, minimum_size=2000, compresslevel=1),
            ],
            exception_handlers={
                BadRequest: lambda request, error: error_response(400, str(error)),
                InputError: lambda request, error: error_response(409, str(error)),
                MeshctlError: lambda request, error: error_response(500, str(error)),
            },
        )

    async def _page(self, request: Request) -> Response:
        return Response(
            (ASSETS / "index.html").read_bytes(), media_type="text/html", headers={"Cache-Control": "no-cache"}
        )

    def _may_change(self, request: Request) -> bool:
        return self.settings.mode == "live" and self.rules.may_change(request.client.host if request.client else "")

    async def _meta(self, request: Request) -> Response:
        span = await run_in_threadpool(self.store.span)
        return _json(
            {
                **self.settings.as_json(),
                "span": span,
                "now_s": self.clock(),
                "actions": self.actions is not None,
                "can_acknowledge": self._may_change(request),
            }
        )

    async def _frame(self, request: Request) -> Response:
        at_s = _number(request, "at", None)
        frame = await run_in_threadpool(self._frame_at, at_s)
        if frame is None:
            return error_response(404, "nothing was recorded before that time")
        return _json_text(frame.json_text)

    def _frame_at(self, at_s: float | None) -> Frame | None:
        if at_s is None:
            return self.store.latest()
        return self.store.at(at_s)

    async def _frames(self, request: Request) -> Response:
        start_s, end_s = await self._range(request)
        limit = int(min(MAX_FRAMES, max(1, _number(request, "limit", 100.0))))
        frames = await run_in_threadpool(self.store.between, start_s, end_s, limit)
        return _json_text(f"[{','.join(frame.json_text for frame in frames)}]")

    async def _timeline(self, request: Request) -> Response:
        start_s, end_s = await self._range(request)
        buckets = int(min(MAX_BUCKETS, max(1, _number(request, "buckets", 240.0))))
        # the end is not in a bucket, but the newest frame should be
        found = await run_in_threadpool(self.store.timeline, start_s, end_s + 0.001, buckets)
        return _json({"from": start_s, "to": end_s, "buckets": [asdict(bucket) for bucket in found]})

    async def _series(self, request: Request) -> Response:
        start_s, end_s = await self._range(request)
        device = request.query_params.get("device", "")
        charts = await run_in_threadpool(
            lambda: charts_of(self.store.between(start_s, end_s, CHART_POINTS), device) if device else []
        )
        return _json({"device": device, "charts": charts})

    async def _report(self, request: Request) -> Response:
        return _json(list(self.report))

    async def _range(self, request: Request) -> tuple[float, float]:
        """`from` and `to`, by default all that was recorded."""
        span = await run_in_threadpool(self.store.span) or (0.0, 0.0)
        start_s, end_s = _number(request, "from", span[0]), _number(request, "to", span[1])
        if end_s < start_s:
            raise BadRequest(f"expected from <= to, found {start_s} and {end_s}")
        return start_s, end_s

    async def _alarms(self, request: Request) -> Response:
        return _json_text(await run_in_threadpool(self.streams.alarms_text))

    async def _acknowledge(self, request: Request) -> Response:
        body = await self._change_body(request)
        by = _text(body, "by", getpass.getuser())
        await run_in_threadpool(self.store.acknowledge, _text(body, "device"), _text(body, "code"), by, self.clock())
        self.feed.notify()
        return await self._alarms(request)

    async def _silence(self, request: Request) -> Response:
        body = await self._change_body(request)
        for_s = body.get("for_s")
        if for_s is not None and not (isinstance(for_s, int | float) and 0 < for_s <= MAX_SILENCE_S):
            raise BadRequest(f"for_s: expected seconds from 0 to {MAX_SILENCE_S:g}, or null, found {for_s!r}")
        until_s = None if for_s is None else self.clock() + for_s
        silence = Silence(until_s, _text(body, "reason"), _text(body, "by", getpass.getuser()))
        code = _text(body, "code")
        if code != ANY and code not in CODES:
            raise BadRequest(f"code: expected a code of an alarm or {ANY}, found {code!r}")
        await run_in_threadpool(self.store.silence, _text(body, "device"), code, silence, self.clock())
        self.feed.notify()
        return await self._alarms(request)

    async def _change_body(self, request: Request) -> Mapping[str, Any]:
        if not self._may_change(request):
            raise InputError("alarms are changed from the monitor's own machine, or with its token")
        return await _body(request)

    async def _metrics(self, request: Request) -> Response:
        if self.metrics is None:
            return error_response(404, "a recording has no metrics")
        render = self.metrics
        text = await run_in_threadpool(lambda: render(self.store.latest(), self.store, self.clock()))
        return PlainTextResponse(text, media_type="text/plain; version=0.0.4; charset=utf-8")

    async def _action(self, request: Request) -> Response:
        assert self.actions is not None, "the route exists only with actions"
        body = await _body(request)
        action = request.path_params["action"]
        if action == "job":
            job = self.actions.job(_text(body, "id"))
        elif action == "confirm":
            job = await run_in_threadpool(self.actions.confirm, _text(body, "id"), _text(body, "confirmation"))
        else:
            job = await run_in_threadpool(self.actions.prepare, action, _text(body, "device"))
        return _json(job.as_json())

    async def _events(self, request: Request) -> Response:
        if self.streams.is_full:
            return error_response(503, "too many pages are open on this monitor: close one of them")
        last_id = request.headers.get("last-event-id", "")
        last_s = int(last_id) / 1000 if last_id.isdecimal() and len(last_id) < 16 else None
        return StreamingResponse(
            self.streams.stream(last_s),
            media_type="text/event-stream",
            headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
        )


def _json(value: object) -> Response:
    return JSONResponse(value, headers={"Cache-Control": "no-store"})


def _json_text(text: str) -> Response:
    return Response(text, media_type="application/json", headers={"Cache-Control": "no-store"})


def _number(request: Request, name: str, default: Any) -> Any:
    given = request.query_params.get(name)
    if given is None:
        return default
    try:
        value = float(given)
    except ValueError:
        value = math.nan
    # from -3000 to 5000, so that milliseconds fit where they are stored
    if not abs(value) < 1e11:
        raise BadRequest(f"{name}: expected a number, found {given!r}")
    return value


def _text(body: Mapping[str, Any], name: str, default: str | None = None) -> str:
    value = body.get(name, default)
    if not isinstance(value, str) or len(value) > 500:
        raise BadRequest(f"{name}: expected a text of at most 500 characters, found {type(value).__name__}")
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise BadRequest(f"{name}: expected text, found an unpaired surrogate") from error
    return value


async def _body(request: Request) -> Mapping[str, Any]:
    text = b""
    async for part in request.stream():
        text += part
        if len(text) > MAX_BODY_BYTES:
            raise BadRequest(f"expected at most {MAX_BODY_BYTES} bytes")
    try:
        body = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadRequest(f"expected JSON: {error}") from error
    if not isinstance(body, dict):
        raise BadRequest(f"expected a JSON object, found {type(body).__name__}")
    return body
