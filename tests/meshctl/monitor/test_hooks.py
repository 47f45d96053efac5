"""Hooks get new alarms once, cannot delay the sampler, and no text of a device becomes code."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from meshctl.errors import InputError
from meshctl.monitor.alarm_log import LoggedAlarm, Silence
from meshctl.monitor.hooks import MAX_WAITING, AlarmHooks, HookSettings
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.monitor.documents import frame
from tests.waiting import until

HOSTILE = 'x"; touch pwned; $(touch pwned) `touch pwned`\n\x1b[31m\x00 <script>'


def alarm(level: str = "error", text: str = "b01 is silent", **other: object) -> LoggedAlarm:
    return LoggedAlarm("b01", "unreachable", level, text, "look", 1.0, 1.0, **other)  # type: ignore[arg-type]


@contextmanager
def receiver(status: int = 200, delay_s: float = 0.0) -> Iterator[tuple[str, list[dict[str, object]]]]:
    """A web server: its URL, and the documents that it got."""
    got: list[dict[str, object]] = []
    release = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            got.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            release.wait(delay_s)
            self.send_response(status)
            self.send_header("Location", "file:///etc/passwd")
            self.end_headers()

        def log_message(self, *arguments: object) -> None:
            """Nothing."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/alarm", got
    finally:
        release.set()
        server.shutdown()
        thread.join()
        server.server_close()


def test_both_hooks_get_the_alarm_as_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MESHCTL_MONITOR_TOKEN", "for browsers alone")
    program = (
        "import json, os, sys; from pathlib import Path; "
        "Path(sys.argv[1]).write_text(json.dumps([json.load(sys.stdin), dict(os.environ), sys.argv[2:]]))"
    )
    out = tmp_path / "out.json"
    with receiver() as (url, got):
        command = (sys.executable, "-c", program, str(out), "two words")
        hooks = AlarmHooks(HookSettings(url, command), "lab")
        hooks.notify([alarm(text=HOSTILE)])
        hooks.close(20)
    assert hooks.problem == ""
    document, environment, arguments = json.loads(out.read_text())
    assert got == [document]
    assert (document["fleet"], document["device"], document["text"]) == ("lab", "b01", HOSTILE)
    assert arguments == ["two words"]
    assert environment["MESHCTL_ALARM_CODE"] == "unreachable"
    assert "MESHCTL_MONITOR_TOKEN" not in environment
    assert environment["MESHCTL_ALARM_TEXT"] == 'x"; touch pwned; $(touch pwned) `touch pwned`  [31m  <script>'
    assert list(tmp_path.iterdir()) == [out]


def test_a_hook_that_hangs_is_given_up_and_notify_never_waits(tmp_path: Path) -> None:
    child = tmp_path / "child"
    # a child that would live on, and holds the pipes
    command = ("sh", "-c", f"sleep 600 & echo $! >{child}.new; mv {child}.new {child}; sleep 600")
    with receiver(delay_s=60) as (url, _):
        hooks = AlarmHooks(HookSettings(url, command, timeout_s=0.3), "lab")
        began = time.monotonic()
        hooks.notify([alarm()] * (MAX_WAITING + 50))
        # far less than the receiver's delay, on any host
        assert time.monotonic() - began < 30
        assert hooks.dropped == 50
        # one of the calls may end before its command has begun
        problem = until(lambda: (child.exists() and hooks.problem) or None, "a call to time out")
        hooks.close()
    assert "no response within 0.3 s" in problem
    assert "did not end within 0.3 s" in problem
    until(lambda: not _is_running(int(child.read_text())), "what the command started to be killed with it")


def _is_running(process: int) -> bool:
    """Whether the process runs; one that waits for its parent to take its exit status does not."""
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        (HookSettings("http://127.0.0.1:9/"), "webhook http://127.0.0.1:9/: "),
        (
            HookSettings("http://127.0.0.1:9/a b"),
            "webhook http://127.0.0.1:9/a b: URL can't contain",
        ),
        (HookSettings(command=("/nonexistent/hook",)), "command /nonexistent/hook: "),
        (HookSettings(command=("false",)), "command false: exit status 1"),
    ],
)
def test_a_failed_hook_is_a_problem(settings: HookSettings, problem: str) -> None:
    said: list[str] = []
    hooks = AlarmHooks(settings, on_problem=said.append)
    hooks.notify([alarm()])
    hooks.close(20)
    assert hooks.problem.startswith(problem)
    assert said == [f"alarm not reported: {hooks.problem}"]


@pytest.mark.parametrize(("status", "problem"), [(200, ""), (500, "500"), (302, "302"), (307, "307")])
def test_a_webhook_is_followed_nowhere_else(status: int, problem: str) -> None:
    with receiver(status) as (url, got):
        hooks = AlarmHooks(HookSettings(url))
        hooks.notify([alarm()])
        hooks.close(20)
    assert len(got) == 1
    assert (problem in hooks.problem) if problem else hooks.problem == ""


def test_only_loud_alarms_above_the_level_are_reported() -> None:
    with receiver() as (url, got):
        hooks = AlarmHooks(HookSettings(url))
        hooks.notify([alarm("note"), alarm(silenced=Silence(None, "known", "bob")), alarm("warning"), alarm()])
        hooks.close(20)
    assert [one["level"] for one in got] == ["warning", "error"]


def test_an_alarm_that_begins_silenced_is_not_reported_and_one_that_continues_is_reported_once(tmp_path: Path) -> None:
    with receiver() as (url, got), FrameStore.open(tmp_path / "h", 1e5, MIN_BYTES) as store:
        hooks = AlarmHooks(HookSettings(url))
        store.silence("b02", "*", Silence(None, "on the shelf", "bob"), 0.0)
        raised = {("b01", "weak"): "warning", ("b02", "weak"): "warning"}
        for time_s in (1.0, 2.0, 3.0):
            hooks.notify(store.append(frame(time_s, raised)))
        hooks.close(20)
    assert [one["device"] for one in got] == ["b01"]


@pytest.mark.parametrize(
    "url",
    [
        *("ftp://x/", "file:///etc/passwd", "example.org/hook", "http://"),
        *("http://x:port/", "http://x:99999/", "http://x:0/", "http://[::1/"),
    ],
)
def test_a_webhook_must_be_a_web_address(url: str) -> None:
    with pytest.raises(InputError, match="expected an http or https URL"):
        HookSettings(url)
    with pytest.raises(InputError, match="expected note, warning, error"):
        HookSettings(min_level="loud")
