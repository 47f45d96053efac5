"""The page's server: what it answers, to whom, and what it refuses."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from meshctl.monitor import event_stream
from meshctl.monitor.access import AccessRules, host_of
from meshctl.monitor.alarm_log import LoggedAlarm
from meshctl.monitor.server import PageSettings
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.monitor.documents import frame
from tests.meshctl.monitor.served import Served, served

TOKEN = "a token of its own kind".replace(" ", "-")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[FrameStore]:
    with FrameStore.open(tmp_path / "history.sqlite", 1e9, MIN_BYTES) as opened:
        for index in range(10):
            opened.append(
                frame(1000.0 + index, {("b02", "unreachable"): "error"} if index >= 5 else None, go=index < 5)
            )
        yield opened


@pytest.fixture
def server(store: FrameStore) -> Iterator[Served]:
    with served(store, clock=lambda: 1009.5) as started:
        yield started


def test_frames_timeline_series_and_alarms(server: Served) -> None:
    assert server.ask("api/frame").body["time_s"] == 1009.0
    assert server.ask("api/frame?at=1004.7").body["time_s"] == 1004.0
    assert server.ask("api/frame?at=999").status == 404
    assert [one["time_s"] for one in server.ask("api/frames?from=1002&to=1008&limit=3").body] == [1002, 1005, 1008]
    buckets = server.ask("api/timeline?buckets=10").body["buckets"]
    assert [bucket["go"] for bucket in buckets] == [True] * 5 + [False] * 5
    assert buckets[9]["errors"] == 1
    (alarm,) = server.ask("api/alarms").body
    assert (alarm["device"], alarm["code"], alarm["first_s"]) == ("b02", "unreachable", 1005.0)
    assert server.ask("api/series?device=b01").body == {"device": "b01", "charts": []}
    meta = server.ask("api/meta").body
    assert (meta["span"], meta["now_s"], meta["actions"], meta["can_acknowledge"]) == (
        [1000, 1009],
        1009.5,
        False,
        True,
    )


def test_the_report_of_recordings_is_served_as_it_was_made(store: FrameStore) -> None:
    report = [{"node": "spot1", "notes": ["</script>"]}]
    with served(store, PageSettings("lab", "0", "replay", has_report=True), report=report) as server:
        assert server.ask("api/report").body == report
        assert server.ask("api/meta").body["has_report"] is True


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("api/frame?at=soon", "at: expected a number, found 'soon'"),
        ("api/frame?at=nan", "at: expected a number, found 'nan'"),
        ("api/frame?at=1e300", "at: expected a number, found '1e300'"),
        ("api/timeline?from=2&to=1", "expected from <= to, found 2.0 and 1.0"),
    ],
)
def test_a_wrong_parameter_is_named(server: Served, path: str, expected: str) -> None:
    answer = server.ask(path)
    assert (answer.status, answer.body) == (400, {"error": expected})


def test_an_alarm_is_acknowledged_once_it_is_open(server: Served) -> None:
    answer = server.ask("api/alarms/ack", {"device": "b02", "code": "unreachable", "by": "ann"})
    assert answer.body[0]["acknowledged"] == {"by": "ann", "at_s": 1009.5}
    assert "no open alarm" in server.ask("api/alarms/ack", {"device": "b01", "code": "weak"}).body["error"]
    assert server.ask("api/alarms/ack", {"device": "b02"}).status == 400
    silence = {"device": "b02", "code": "unreachable", "reason": "in repair", "by": "ann", "for_s": 60}
    assert server.ask("api/alarms/silence", silence).body[0]["silenced"]["until_s"] == 1069.5
    assert server.ask("api/alarms/silence", {**silence, "for_s": -1}).status == 400
    assert server.ask("api/alarms/silence", {**silence, "device": "b07"}).body["error"] == "unknown device 'b07'"
    assert server.ask("api/alarms/silence", {**silence, "code": "tired"}).status == 400
    assert (
        server.ask("api/alarms/silence", {**silence, "reason": " "}).body["error"]
        == "expected a reason for the silence"
    )


def test_a_recording_is_read_only(store: FrameStore) -> None:
    with served(store, PageSettings("lab", "0", "replay")) as server:
        assert server.ask("api/alarms/ack", {"device": "b02", "code": "unreachable"}).status == 409
        assert server.ask("metrics").status == 404
        assert server.ask("api/actions/reboot", {"device": "b02"}).status == 404


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "192.168.1.5"])
def test_a_foreign_host_name_is_refused(server: Served, host: str) -> None:
    assert server.ask("api/frame", headers={"Host": host}).status == 421


def test_hosts_that_are_ours() -> None:
    local, remote = AccessRules(), AccessRules("t", frozenset(("base.lan",)), accept_addresses=True)
    assert all(local.accepts_host(host) for host in ("localhost:8642", "127.0.0.1", "[::1]:8642", "LOCALHOST."))
    assert all(remote.accepts_host(host) for host in ("192.168.1.5:8642", "base.lan:80", "[fe80::1]"))
    assert not remote.accepts_host("other.lan")
    assert host_of("[::1]:80") == "::1"


def test_a_token_guards_the_data_and_not_the_empty_page(store: FrameStore) -> None:
    with served(store, rules=AccessRules(TOKEN)) as server:
        assert server.ask("").status == 200
        for path in ("api/frame", "api/events", "api/meta", "metrics"):
            assert server.ask(path).status == 401
            assert server.ask(path, headers={"Authorization": "Bearer wrong"}).status == 401
        assert server.ask("api/frame", headers={"Authorization": f"Bearer {TOKEN}"}).status == 200


def test_another_sites_page_reads_nothing(server: Served) -> None:
    for site, status in (("cross-site", 403), ("same-site", 403), ("same-origin", 200), ("none", 200)):
        for path in ("api/frame", "api/alarms", "metrics"):
            found = server.ask(path, headers={"Sec-Fetch-Site": site}).status
            # this server has no metrics
            assert found == (404 if path == "metrics" and status == 200 else status), (path, site)
    assert server.ask("", headers={"Sec-Fetch-Site": "cross-site"}).status == 200, "a link to the page may be followed"


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (
            b'{"device": "b02", "code": "unreachable", "by": "\\ud800"}',
            "by: expected text, found an unpaired surrogate",
        ),
        (b"[" * 16_000, "expected JSON: "),
        (b'{"device": "\xff"}', "expected JSON: "),
        (b"[]", "expected a JSON object, found list"),
    ],
)
def test_a_hostile_body_is_refused(server: Served, body: bytes, expected: str) -> None:
    answer = server.ask("api/alarms/ack", body)
    assert (answer.status, answer.body["error"].startswith(expected)) == (400, True), answer


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Origin": "null"},
        {"Content-Type": "text/plain"},
    ],
)
def test_another_sites_page_changes_nothing(server: Served, headers: dict[str, str]) -> None:
    answer = server.ask("api/alarms/ack", {"device": "b02", "code": "unreachable"}, headers)
    assert answer.status in (403, 415)
    assert server.ask("api/alarms").body[0]["acknowledged"] is None


def test_every_answer_has_the_policy_and_no_cookie(server: Served) -> None:
    for path in ("", "assets/main.js", "api/frame", "api/nothing", "assets/../server.py"):
        headers = server.ask(path).headers
        assert headers["content-security-policy"].startswith("default-src 'self'; "), path
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert "set-cookie" not in headers
    assert server.ask("assets/../server.py").status == 404


def events(server: Served, last_id: str | None, count: int) -> list[tuple[str, str]]:
    """The first events of a stream, as (event and id, data)."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    try:
        connection.request("GET", "/api/events", headers={} if last_id is None else {"Last-Event-ID": last_id})
        answer = connection.getresponse()
        found: list[tuple[str, str]] = []
        head: list[str] = []
        while len(found) < count:
            line = answer.fp.readline().decode().rstrip("\n")
            if line.startswith("data: "):
                found.append((" ".join(head), line[6:]))
                head = []
            elif line.startswith(("event: ", "id: ")):
                head.append(line.partition(": ")[2])
        return found
    finally:
        connection.close()


def test_a_stream_begins_with_the_newest_frame_and_resumes_after_the_last_one_seen(server: Served) -> None:
    (head, data), (alarms, _) = events(server, None, 2)
    assert (head, json.loads(data)["time_s"], alarms) == ("frame 1009000", 1009.0, "alarms")
    missed = events(server, "1006000", 4)
    assert [head for head, _ in missed] == ["frame 1007000", "frame 1008000", "frame 1009000", "alarms"]
    # from nowhere, or from another history
    assert events(server, "not-a-number", 1)[0][0] == "frame 1009000"
    assert events(server, "99999999999999", 1)[0][0] == "frame 1009000"


def test_a_new_frame_is_sent_to_open_streams(server: Served) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request("GET", "/api/events", headers={"Last-Event-ID": "1009000"})
    answer = connection.getresponse()
    while not answer.fp.readline().startswith(b"event: alarms"):
        pass
    server.append(frame(1010.0))
    while (line := answer.fp.readline()) != b"event: frame\n":
        assert line
    assert answer.fp.readline() == b"id: 1010000\n"
    connection.close()


def test_what_is_sent_is_built_once_for_all_pages_and_these_are_limited(
    store: FrameStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[float] = []
    alarms = FrameStore.alarms

    def counted(self: FrameStore, *, active_only: bool = True, now_s: float) -> tuple[LoggedAlarm, ...]:
        built.append(now_s)
        return alarms(self, active_only=active_only, now_s=now_s)

    monkeypatch.setattr(FrameStore, "alarms", counted)
    monkeypatch.setattr(event_stream, "MAX_STREAMS", 4)
    with served(store, clock=lambda: 1009.5) as server, ExitStack() as stack:
        answers = []
        for _ in range(4):
            connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
            stack.callback(connection.close)
            connection.request("GET", "/api/events")
            answers.append(connection.getresponse())
        for answer in answers:
            while not answer.fp.readline().startswith(b"event: alarms"):
                pass
        assert len(built) == 1
        refused = server.ask("api/events")
        assert (refused.status, "too many pages" in refused.body["error"]) == (503, True)
        server.append(frame(1010.0))
        for answer in answers:
            while answer.fp.readline() != b"id: 1010000\n":
                pass
        assert len(built) == 2
