"""Server-sent events for every open page: frames as they are appended, alarms when they change.

Events are built once per change for all pages: `FrameStore.revision` says whether the file changed, also by
another process. docs/monitor.md describes the events.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from starlette.concurrency import run_in_threadpool

from meshctl.monitor.feed import Feed
from meshctl.monitor.frame import Frame
from meshctl.monitor.store import FrameStore, Revision

# Another process may append to the history or acknowledge an alarm: look again after this long.
POLL_S = 1.0
# A comment after this long without an event tells a browser that the connection lives.
HEARTBEAT_S = 5.0
# A silence ends without a change in the file.
ALARMS_EVERY_S = 5.0
# A browser that was away gets so many of the frames it missed, evenly thinned, and the newest.
MAX_CATCH_UP = 20
# Pages that are open at once: tablets of a large team, and a limit to what one faulty client may cost.
MAX_STREAMS = 40


@dataclass(frozen=True, slots=True)
class _Update:
    revision: Revision
    built_s: float
    latest: Frame | None
    alarms: str


class EventStreams:
    """The streams of one server. `clock` is Unix time; a recording (`is_live` False) has the alarms of its end."""

    def __init__(self, store: FrameStore, feed: Feed, clock: Callable[[], float], *, is_live: bool) -> None:
        self._store = store
        self._feed = feed
        self._clock = clock
        self._is_live = is_live
        self.meters: Callable[[], Mapping[str, Any]] = dict
        self._lock = threading.Lock()
        self._built: _Update | None = None
        self._open = 0

    @property
    def is_full(self) -> bool:
        return self._open >= MAX_STREAMS

    def alarms_text(self) -> str:
        """All alarms that are kept, as JSON."""
        return self._update().alarms

    async def stream(self, last_s: float | None) -> AsyncIterator[str]:
        """Frames newer than `last_s`, and the alarms whenever they changed, until the server stops."""
        self._open += 1
        try:
            async for text in self._texts(last_s):
                yield text
        finally:
            self._open -= 1

    async def _texts(self, last_s: float | None) -> AsyncIterator[str]:
        yield ": meshctl monitor\n\n"
        update = await run_in_threadpool(self._update)
        sent_s = -math.inf if last_s is None else last_s
        if update.latest is not None and sent_s > update.latest.time_s:
            # another history, or a clock that was set back: the browser has seen none of these frames
            sent_s = -math.inf
        for frame in await run_in_threadpool(self._missed, sent_s, update.latest):
            yield _frame_event(frame)
            sent_s = frame.time_s
        alarms, meters, quiet_s = "", "{}", 0.0
        while not self._feed.is_closed:
            quiet_s += POLL_S
            if update.latest is not None and update.latest.time_s > sent_s:
                yield _frame_event(update.latest)
                sent_s, quiet_s = update.latest.time_s, 0.0
            if update.alarms != alarms:
                alarms, quiet_s = update.alarms, 0.0
                yield _event("alarms", alarms)
            # newer than the newest frame
            if (readings := _one_line(self.meters())) != meters:
                meters, quiet_s = readings, 0.0
                yield _event("meters", meters)
            if quiet_s >= HEARTBEAT_S:
                yield ": alive\n\n"
                quiet_s = 0.0
            await self._feed.wait(POLL_S)
            update = await run_in_threadpool(self._update)

    def _missed(self, sent_s: float, latest: Frame | None) -> tuple[Frame, ...]:
        """The frames between `sent_s`, the last one a browser has seen, and `latest`."""
        if latest is None or not math.isfinite(sent_s):
            return ()
        return tuple(
            frame
            for frame in self._store.between(sent_s + 0.001, latest.time_s, MAX_CATCH_UP)
            if frame.time_s < latest.time_s
        )

    def _update(self) -> _Update:
        with self._lock:
            revision, now_s = self._store.revision(), self._clock()
            known = self._built
            if known is None or known.revision != revision or abs(now_s - known.built_s) >= ALARMS_EVERY_S:
                self._built = known = _Update(revision, now_s, self._store.latest(), self._alarms_at(now_s))
            return known

    def _alarms_at(self, now_s: float) -> str:
        if not self._is_live and (span := self._store.span()) is not None:
            now_s = span[1]
        return json.dumps([alarm.as_json() for alarm in self._store.alarms(active_only=False, now_s=now_s)])


def _one_line(value: object) -> str:
    return json.dumps(value, separators=(",", ":"))


def _frame_event(frame: Frame) -> str:
    return _event("frame", frame.json_text, round(frame.time_s * 1000))


def _event(kind: str, data: str, number: int | None = None) -> str:
    head = f"event: {kind}\n" + (f"id: {number}\n" if number is not None else "")
    # the documents are JSON on one line
    return f"{head}data: {data}\n\n"
