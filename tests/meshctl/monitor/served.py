"""The page's server on loopback, in a thread."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import uvicorn

from meshctl.monitor.feed import Feed
from meshctl.monitor.frame import Frame
from meshctl.monitor.serve import listen
from meshctl.monitor.server import MonitorServer, PageSettings
from meshctl.monitor.store import FrameStore
from tests.waiting import until

SETTINGS = PageSettings("lab", "0", topic_classes={"telemetry": "telemetry", "artifacts": "artifact"})


@dataclass(frozen=True, slots=True)
class Answer:
    status: int
    headers: Mapping[str, str]
    text: str

    @property
    def body(self) -> Any:
        return json.loads(self.text)


@dataclass(frozen=True, slots=True)
class Served:
    port: int
    feed: Feed
    store: FrameStore

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def append(self, frame: Frame) -> None:
        self.store.append(frame)
        self.feed.notify()

    def ask(self, path: str, body: object = None, headers: Mapping[str, str] | None = None) -> Answer:
        data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        given = {**({} if data is None else {"Content-Type": "application/json"}), **(headers or {})}
        request = urllib.request.Request(self.url + path, data, given)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return Answer(answer.status, dict(answer.headers), answer.read().decode())
        except urllib.error.HTTPError as error:
            with error:
                return Answer(error.code, dict(error.headers), error.read().decode())


@contextmanager
def served(
    store: FrameStore,
    settings: PageSettings = SETTINGS,
    *,
    port: int = 0,
    meters: Callable[[], dict[str, Mapping[str, Any]]] | None = None,
    **parts: Any,
) -> Iterator[Served]:
    feed = Feed()
    page = MonitorServer(store, feed, settings, **parts)
    if meters is not None:
        page.streams.meters = meters
    app = page.app()
    listening = listen("127.0.0.1", port)
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, access_log=False, timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    number = listening.getsockname()[1]
    thread.start()
    try:
        until(lambda: server.started, "the server")
        yield Served(number, feed, store)
    finally:
        feed.close()
        server.should_exit = True
        thread.join(60)
        listening.close()
