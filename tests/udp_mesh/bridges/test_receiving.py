"""What a bridge is configured to receive, and that it subscribes to that and nothing else."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from udp_mesh.bridges import daemon_client
from udp_mesh.bridges.configuration import EMPTY, BridgeConfigurationError, parse_configuration
from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.receiving import EVERYTHING, Receive, parse_receive, with_needed


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("map", Receive("map")),
        ("video rate_hz=1", Receive("video", 1.0)),
        (" artifacts/*  max_age_s=0.5 rate_hz=2 ", Receive("artifacts/*", 2.0, 0.5)),
    ],
)
def test_an_entry_is_a_pattern_with_bounds(text: str, expected: Receive) -> None:
    assert parse_receive(text) == expected


@pytest.mark.parametrize("text", ["", "map rate=1", "map rate_hz=fast", "map rate_hz=0", "map rate_hz=nan", "map 5"])
def test_a_faulty_entry_is_refused_with_what_is_expected(text: str) -> None:
    with pytest.raises(ValueError, match="expected TOPIC"):
        parse_receive(text)


def test_a_bridge_without_entries_receives_everything_and_one_with_some_also_what_it_needs() -> None:
    assert with_needed([], ["bridge/*"]) == list(EVERYTHING)
    assert with_needed([Receive("map")], ["bridge/*"]) == [Receive("map"), Receive("bridge/*")]


def test_a_file_of_one_value_is_not_quoted_because_it_may_be_a_key() -> None:
    with pytest.raises(BridgeConfigurationError) as raised:
        parse_configuration("f772a084226a36ec", "fleet.key")
    assert str(raised.value) == "fleet.key:1:1: file: expected a mapping, found a single value"


def test_the_file_of_a_bridge_lists_what_it_receives() -> None:
    text = 'receive:\n  map: {}\n  "artifacts/*": {}\n  video: { rate_hz: 1, max_age_s: 2 }\n'
    found = parse_configuration(text, "bridge.yaml").receive
    assert found == (Receive("map"), Receive("artifacts/*"), Receive("video", 1.0, 2.0))
    assert EMPTY.receive == parse_configuration("tf: {}\n", "bridge.yaml").receive == ()
    with pytest.raises(BridgeConfigurationError, match=r"bridge.yaml:2:21: receive.video.rate_hz: expected"):
        parse_configuration("receive:\n  video: { rate_hz: 0 }\n", "bridge.yaml")


def test_the_connection_subscribes_to_each_entry_with_its_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = threading.Event()
    subscribed: list[tuple[str, float | None, float | None]] = []

    class Client:
        def __init__(self, path: str) -> None:
            assert path == "daemon.sock"

        def __enter__(self) -> Client:
            return self

        def __exit__(self, *_: object) -> None:
            stop.set()

        def subscribe(self, pattern: str, *, rate_hz: float | None, max_age_s: float | None) -> None:
            subscribed.append((pattern, rate_hz, max_age_s))

        def request(self, op: str, **_: Any) -> None:
            assert op == "events"

        def next_frame(self, _: float) -> None:
            stop.set()

    monkeypatch.setattr(daemon_client, "MeshClient", Client)
    monkeypatch.setattr(daemon_client, "RECONNECT_S", 0.0)
    DaemonClient("daemon.sock", [Receive("map"), Receive("video", 1.0, 2.0)]).run(stop, lambda: None, lambda _: None)
    assert subscribed == [("map", None, None), ("video", 1.0, 2.0)]
