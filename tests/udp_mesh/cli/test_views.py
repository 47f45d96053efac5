"""The daemon's replies as text."""

import json
from dataclasses import asdict, replace

import pytest

from tests.udp_mesh.core.pair import pair
from udp_mesh.cli import output
from udp_mesh.cli.inspect import screen_text
from udp_mesh.cli.views import peers_view, relays_view, topics_view
from udp_mesh.core.link_trend import Direction, Measure, Trend
from udp_mesh.core.relaying.conditions import RelayConditions, RelayCounters
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.core.versions.conditions import VersionConditions, VersionCounters
from udp_mesh.daemon.status import peer_json, relaying_json, topics_json


@pytest.mark.parametrize(
    ("online", "one_way", "unanswered_for_s", "word"),
    [
        (True, False, None, "online"),
        (True, False, 1.0, "online"),
        (True, False, 14.0, "NO ANSWER"),
        (True, True, 14.0, "ONE WAY"),
        (False, False, 14.0, "OFFLINE"),
    ],
)
def test_peers_view_shows_one_state_per_peer(
    online: bool, one_way: bool, unanswered_for_s: float | None, word: str
) -> None:
    both = pair()
    (found,) = both.a.conditions(both.now).peers
    peer = replace(found, online=online, one_way=one_way, unanswered_for_s=unanswered_for_s)
    line = peers_view([peer_json(peer, both.now)]).splitlines()[-1]
    assert f" {word} " in line
    assert ("14" in line) == (word == "NO ANSWER")


def test_topics_view_shows_what_differences_saved() -> None:
    counters = VersionCounters(
        whole_sent=2,
        differences_sent=7,
        bases_lost=1,
        payload_bytes_sent=9_000_000,
        body_bytes_sent=2_200_000,
        whole_received=3,
        differences_received=4,
        bases_missing=1,
        damaged=1,
    )
    settings = Settings("a", unkeyed=True, topics=(Topic("map", 7, delta=True), Topic("status", 0)))
    topics = topics_json(settings, {}, 0.0, (VersionConditions("map", counters), VersionConditions("old", counters)))
    assert {topic["name"]: topic["versions"] for topic in topics} == {"map": asdict(counters), "status": None}
    assert [(topic["delta"], topic["delta_bytes"]) for topic in topics] == [(False, 16 << 20), (True, 16 << 20)]
    lines = topics_view({"topics": topics, "undeclared": None}).splitlines()
    (head,) = (number for number, line in enumerate(lines) if line.startswith("versions of"))
    assert lines[head + 1].split() == ["map", "2", "7", "9", "MB", "2.2", "MB", "3", "4", "3"]
    assert lines[head + 2 :] == ["", "other topics are refused"]
    without = topics_view({"topics": [{**topic, "versions": None} for topic in topics], "undeclared": None})
    assert "versions of" not in without


HOSTILE = "\x1b[2J\x1b]52;c;aGk=\x07\x9b2J\u202egnp.exe\nbob  online\x7f"


def test_terminal_control_sequences_in_names_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    lines = output.table(("peer", "state"), [(HOSTILE, "online")]).splitlines()
    assert len(lines) == 2, "a line end in a name begins no row"
    output.print_text(HOSTILE)
    output.print_json({"name": HOSTILE})
    output.print_json_line({"name": HOSTILE})
    output.print_error(HOSTILE)
    drawn = screen_text(HOSTILE, 80, 24)
    shown = "".join([*lines, *capsys.readouterr()])
    for sequence in ("\x1b", "\x07", "\x9b", "\u202e", "\x7f"):
        assert sequence not in shown
    for sequence in ("\x1b[2J", "\x1b]", "\x07", "\x9b", "\u202e"):
        assert sequence not in drawn
    output.print_json_line({"name": HOSTILE})
    assert json.loads(capsys.readouterr().out) == {"name": HOSTILE}


def test_peers_view_shows_relays_trend_and_what_is_left_for_a_priority() -> None:
    both = pair()
    (found,) = both.a.conditions(both.now).peers
    trend = Trend(Direction.WORSENING, Measure.CAPACITY, -0.02)
    left = (8e6,) * 3 + (5e6,) * 4 + (0.0,) * 9
    peer = replace(found, link="relay", via=("r1", "r2"), trend=trend, available_bits_per_s=left)
    text = peers_view([peer_json(peer, both.now)])
    assert "relay through r1 > r2" in text
    assert " worsening " in text
    assert [line.split() for line in text.splitlines()[-3:]] == [
        ["b", "0", "to", "2", "8", "Mbit/s"],
        ["b", "3", "to", "6", "5", "Mbit/s"],
        ["b", "7", "to", "15", "0", "bit/s"],
    ]
    assert peer_json(peer, both.now)["trend"] == {
        "direction": "worsening",
        "measure": "capacity",
        "change_per_s": -0.02,
    }
    # nothing more to tell than the capacity, and a daemon of an earlier version
    even = peer_json(replace(peer, available_bits_per_s=(8e6,) * 16), both.now)
    assert "left for" not in peers_view([even])
    for key in ("via", "trend", "available_bits_per_s"):
        del even[key]
    assert "through" not in peers_view([even])


def test_the_view_of_a_relay_names_the_causes_of_dropped_datagrams() -> None:
    counters = RelayCounters(passed_on=378, passed_on_bytes=227_000, dropped_queue=3, dropped_loop=1)
    conditions = RelayConditions(
        relays=True, active=True, neighbours=(), routes=(), counters=counters, queued_bytes=12_000
    )
    lines = relays_view(relaying_json(conditions))
    assert lines == ["", "relay: 378 datagrams forwarded (227 kB), 4 dropped (3 queue, 1 loop), 12 kB queued"]
