"""What a collector reports of the radio: parsed, aged, shown, and at a real daemon."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons
from udp_mesh.cli.views import peers_view, status_view
from udp_mesh.client import MeshError
from udp_mesh.daemon.interface import CONDITIONS_TOPIC
from udp_mesh.daemon.radio_paths import MAX_AGE_S, BadReport, parse_report, with_radio
from udp_mesh.report.aggregate import read
from udp_mesh.report.figures import summary

pytestmark = pytest.mark.xdist_group("udp_mesh_radio_paths")

PATH = {
    "peer": "bob",
    "radio": "alice-radio",
    "next_hop": "b02",
    "age_s": 1.0,
    "signal_dbm": -67,
    "noise_dbm": -95,
    "margin_db": 11.5,
    "bottleneck_bits_per_s": 13e6,
    "quality": 0.8,
    "trend": "worsening",
    "change_db_per_s": -0.4,
}
NEIGHBOR = {"name": "b02", "radio": "alice-radio", "age_s": 1.0, "signal_dbm": -67, "margin_db": 11.5}
REPORT = {"source": "alice-radio", "problem": "", "paths": [PATH], "neighbors": [NEIGHBOR]}
SHOWN = {
    **{key: value for key, value in PATH.items() if key not in ("peer", "change_db_per_s")},
    "source": "alice-radio",
    "trend": {"direction": "worsening", "change_db_per_s": -0.4},
}


def report(**changes: object) -> bytes:
    return json.dumps({**REPORT, **changes}).encode()


def shown(payload: bytes, received: float, now: float) -> dict[str, Any]:
    conditions: dict[str, object] = {"peers": [{"name": "bob"}, {"name": "carol"}]}
    found: dict[str, Any] = json.loads(json.dumps(with_radio(conditions, parse_report(payload, received), now)))
    return found


def test_each_value_is_shown_with_its_age() -> None:
    found = shown(report(), 100.0, 102.5)
    assert [peer["radio"] for peer in found["peers"]] == [{**SHOWN, "age_s": 3.5}, None]
    assert found["radio"] == {
        "source": "alice-radio",
        "problem": None,
        "age_s": 2.5,
        "neighbors": [{**NEIGHBOR, "age_s": 3.5}],
    }


def test_old_values_are_left_out_even_if_the_collector_still_reports() -> None:
    old = report(problem="alice-radio does not answer", paths=[{**PATH, "age_s": 9.0}])
    assert shown(old, 100.0, 100.9)["peers"][0]["radio"] is not None
    found = shown(old, 100.0, 101.1)
    assert found["peers"][0]["radio"] is None
    assert found["radio"]["problem"] == "alice-radio does not answer"
    # and without a collector
    assert shown(report(), 100.0, 100.0 + MAX_AGE_S + 0.1)["radio"] is None


def test_without_a_collector_nothing_is_known() -> None:
    assert with_radio({"peers": [{"name": "bob"}]}, None, 5.0) == {
        "peers": [{"name": "bob", "radio": None}],
        "radio": None,
    }


def test_unknown_values_and_keys_of_later_versions_are_accepted() -> None:
    unknown = dict.fromkeys(set(PATH) - {"peer", "radio", "next_hop", "age_s"})
    found = shown(report(paths=[{**PATH, **unknown, "later": [1]}], later=2), 0.0, 0.0)["peers"][0]["radio"]
    assert found == {**dict.fromkeys(SHOWN), "source": "alice-radio", "radio": "alice-radio", "next_hop": "b02"} | {
        "age_s": 1.0
    }


@pytest.mark.parametrize(
    ("payload", "complaint"),
    [
        (b"\xff", "payload: expected a JSON object"),
        (b"[" * 200_000, "payload: expected a JSON object"),
        (b"[]", "payload: expected a JSON object, found []"),
        (b"{}" + b" " * (1 << 20), "payload: expected at most 1048576 bytes"),
        (report(source=""), "source: expected printable text of 1 to 63 characters, found ''"),
        (report(source="a\nb"), "source: expected printable text"),
        (report(problem=3), "problem: expected text, found 3"),
        (report(paths={}), "paths: expected a list of at most 1024 objects"),
        (report(paths=[PATH] * 1025), "paths: expected a list of at most 1024 objects"),
        (report(paths=[3]), "paths[0]: expected an object, found 3"),
        (report(neighbors=[NEIGHBOR, {**NEIGHBOR, "signal_dbm": None}]), "neighbors[1].signal_dbm: expected a number"),
        (report(paths=[{**PATH, "age_s": -1}]), "paths[0].age_s: expected a number from 0 to 1e+09, found -1"),
        (report(paths=[{**PATH, "margin_db": float("nan")}]), "paths[0].margin_db: expected a number"),
        (report(paths=[{**PATH, "margin_db": True}]), "paths[0].margin_db: expected a number"),
        (report(paths=[{**PATH, "quality": 10**400}]), "paths[0].quality: expected a number from 0 to 1"),
        (report(paths=[{**PATH, "trend": "up"}]), "paths[0].trend: expected one of improving, steady, worsening"),
        (report(paths=[{**PATH, "trend": []}]), "paths[0].trend: expected one of"),
    ],
)
def test_an_invalid_report_is_refused_with_the_place(payload: bytes, complaint: str) -> None:
    with pytest.raises(BadReport) as refused:
        parse_report(payload, 0.0)
    assert str(refused.value).startswith(complaint)


@pytest.fixture(scope="module")
def pair() -> Iterator[tuple[RunningDaemon, RunningDaemon]]:
    with two_daemons() as daemons:
        yield daemons


def test_a_daemon_attaches_the_report_to_its_conditions(pair: tuple[RunningDaemon, RunningDaemon]) -> None:
    alice, _ = pair
    with alice.client() as client, alice.client() as reader:
        assert client.request("peers")["peers"][0]["radio"] is None
        with pytest.raises(MeshError) as refused:
            client.request("set-radio", b"{}")
        assert refused.value.code == "bad-request"
        client.request("set-radio", report())
        (peer,) = client.request("peers")["peers"]
        assert peer["radio"]["margin_db"] == 11.5
        assert peer["radio"]["age_s"] >= 1.0
        status = client.request("status")
        assert status["conditions"]["radio"]["neighbors"][0]["name"] == "b02"
        client.request("set-radio", report(problem="alice-radio does not answer"))
        reader.subscribe(CONDITIONS_TOPIC)

        def published() -> dict[str, Any] | None:
            frame = reader.next_frame()
            assert frame is not None
            return frame[0]["conditions"] if frame[0].get("event") == "conditions" else None

        conditions = poll(published, "conditions")
        assert conditions["radio"]["problem"] == "alice-radio does not answer"
        assert conditions["peers"][0]["radio"]["next_hop"] == "b02"
        text = status_view(client.request("status"))
    assert "RADIO: alice-radio does not answer" in text
    line = next(line for line in text.splitlines() if line.startswith("bob  alice-radio") or " b02 " in line)
    assert line.split()[:9] == ["bob", "alice-radio", "b02", "-67", "dBm", "12", "dB", "13", "Mbit/s"]


def test_a_daemon_exports_and_records_the_report(pair: tuple[RunningDaemon, RunningDaemon], tmp_path: Path) -> None:
    alice, _ = pair
    file = tmp_path / "run.jsonl"
    with alice.client() as client:
        client.request("set-radio", report())
        client.request("record-start", path=str(file))
        client.request("set-radio", report(paths=[{**PATH, "next_hop": "b03", "margin_db": 7.5}], problem="is down"))
        client.request("record-stop")
        page = client.request_frame("metrics")[1].decode()
    assert 'udp_mesh_radio_path_margin_db{peer="bob"} 7.5' in page.splitlines()
    found = read(file)
    assert found.problems == []
    (path,) = summary(found)["radio_paths"]
    assert (path["peer"], path["changes"], path["least_margin_db"]) == ("bob", 1, 7.5)
    assert [event.text for event in found.events["radio-problem"].items()] == ["is down"]


def test_status_of_an_earlier_daemon_has_no_radio() -> None:
    peer = {"name": "bob", "legacy": False, "one_way": False, "online": False, "online_for_s": None, "heard_ago_s": 1.0}
    peer |= {"unanswered_for_s": None, "address": None, "link": None, "round_trip_s": None, "loss": 0.0, "queues": []}
    peer |= {"sent_bits_per_s": 0.0, "received_bits_per_s": 0.0, "capacity_bits_per_s": None, "outbox_messages": 0}
    assert "radio" not in peers_view([peer])
