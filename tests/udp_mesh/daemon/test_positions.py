"""Positions: set by a program or the configuration, sent to all as a small topic, kept with their age, recorded."""

import itertools
import json
import math
import struct
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons
from udp_mesh import Node, Settings
from udp_mesh.client import MeshError
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.legacy.sender import can_publish
from udp_mesh.daemon.configuration import read
from udp_mesh.daemon.interface import METER_TOPIC, POSITION_TOPIC, RESERVED_PREFIX
from udp_mesh.daemon.position_exchange import POSITION_TYPE
from udp_mesh.daemon.positions import (
    MAX_POSITIONS,
    MOVED_PERIOD_S,
    STILL_PERIOD_S,
    Position,
    Positions,
    PositionSource,
    decode,
    encode,
)
from udp_mesh.daemon.toml_source import ConfigurationError, parse

Pair = tuple[RunningDaemon, RunningDaemon]

pytestmark = pytest.mark.xdist_group("udp_mesh_positions")

HERE = Position(1.5, -2.0, 3.0, "map", 100.0, PositionSource.API)


def test_a_position_arrives_with_its_age_in_a_few_tens_of_bytes() -> None:
    message = encode(HERE, now=101.5)
    assert len(message) == 21
    # another machine's clock
    assert decode(message, now=7.0) == replace(HERE, taken_at=5.5, source=PositionSource.PEER)
    flat = decode(encode(replace(HERE, z_m=None), 100.0), 0.0)
    assert flat is not None
    assert flat.z_m is None


@given(st.binary(max_size=60))
def test_no_bytes_raise(payload: bytes) -> None:
    found = decode(payload, 0.0)
    assert found is None or (math.isfinite(found.x_m) and found.frame.isprintable())


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        struct.pack(">BBIfff", 1, 1, 0, math.nan, 0, 0) + b"map",
        struct.pack(">BBIfff", 1, 1, 0, 1e9, 0, 0) + b"map",
        struct.pack(">BBIfff", 2, 1, 0, 0, 0, 0) + b"map",
        struct.pack(">BBIfff", 1, 1, 0, 0, 0, 0) + b"\x1b[2J",
        struct.pack(">BBIfff", 1, 1, 0, 0, 0, 0) + b"\xff",
        struct.pack(">BBIfff", 1, 1, 0, 0, 0, 0),
    ],
)
def test_another_version_and_implausible_values_are_no_position(payload: bytes) -> None:
    assert decode(payload, 0.0) is None


def test_a_moving_node_sends_every_two_seconds_and_a_still_one_every_ten() -> None:
    positions = Positions()
    assert positions.due(0.0) is None
    sent = []
    for tenth in range(600):
        now = tenth / 10
        x_m = min(now, 20.0)
        positions.set_own(replace(HERE, x_m=x_m, taken_at=now))
        if positions.due(now) is not None:
            sent.append(now)
    gaps = [later - before for before, later in itertools.pairwise(sent)]
    assert set(map(round, gaps)) == {round(MOVED_PERIOD_S), round(STILL_PERIOD_S)}
    assert gaps[:10] == pytest.approx([MOVED_PERIOD_S] * 10)
    assert gaps[-3:] == pytest.approx([STILL_PERIOD_S] * 3)


def test_invented_names_do_not_fill_the_memory() -> None:
    positions = Positions()
    message = encode(HERE, 100.0)
    for number in range(MAX_POSITIONS + 50):
        positions.receive(f"n{number}", message, 0.0)
        if number % 100 == 0:
            positions.receive("bob", message, 0.0)
    assert positions.receive("alice", message, 1.0) is not None
    known = [entry["name"] for entry in positions.json("own", 0.0)]
    assert len(known) == MAX_POSITIONS
    assert {"alice", "bob"} <= set(known)


def test_peers_of_earlier_versions_get_nothing_that_they_would_pass_on() -> None:
    # a legacy program only gets what has the type of a ROS message
    assert not can_publish(POSITION_TYPE)
    # every daemon ignores topics of this prefix that it does not know; programs never see them
    assert POSITION_TOPIC.startswith(RESERVED_PREFIX)
    arrived = MessageReceived("alice", POSITION_TOPIC, POSITION_TYPE, encode(HERE, 100.0), 13, True)
    node = Node(Settings("bob", unkeyed=True))
    node._event(arrived)
    node._event(replace(arrived, topic="status"))
    assert [message.topic for message in node._messages] == ["status"]


def test_a_configured_position_does_not_age_and_a_program_overrides_it() -> None:
    fixed = replace(HERE, taken_at=0.0, source=PositionSource.CONFIGURATION)
    positions = Positions(fixed)
    assert positions.json("base", 500.0)[0]["age_s"] == 0.0
    positions.set_own(replace(HERE, x_m=9.0, taken_at=400.0))
    assert positions.json("base", 500.0)[0] == {
        "name": "base", "x_m": 9.0, "y_m": -2.0, "z_m": 3.0, "frame": "map", "age_s": 100.0, "source": "api",
    }  # fmt: skip
    # an older measurement that arrives late
    positions.set_own(replace(HERE, x_m=8.0, taken_at=399.0))
    assert positions.json("base", 500.0)[0]["x_m"] == 9.0
    positions.set_fixed(None)
    assert positions.json("base", 500.0)[0]["x_m"] == 9.0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("x_m = 1", "position.y_m: expected a number of meters, found none"),
        ('x_m = 1\ny_m = "here"', 'position.y_m: expected a number from -1e+07 to 1e+07, found "here"'),
        ("x_m = 1\ny_m = nan", "position.y_m: expected a number from"),
        ('x_m = 1\ny_m = 2\nframe = "a b"', "position.frame: expected a name of 1 to 64 bytes without spaces"),
        ("x_m = 1\ny_m = 2\nheading = 3", "position.heading: expected a known key"),
    ],
)
def test_an_invalid_configured_position_is_reported_with_its_line(text: str, complaint: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read(parse(f"unkeyed = true\n\n[position]\n{text}\n", "mesh.toml"), ())
    assert complaint in str(caught.value)
    assert str(caught.value).startswith("mesh.toml:")


# Two daemons


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with two_daemons(alice_more="[position]\nx_m = 12.5\ny_m = -3\n") as daemons:
        yield daemons


def places(daemon: RunningDaemon) -> dict[str, dict[str, Any]]:
    with daemon.client() as client:
        return {place["name"]: place for place in client.request("status")["positions"]}


def test_each_daemon_learns_the_others_position_and_records_it(pair: Pair) -> None:
    alice, bob = pair
    found = poll(lambda: places(bob).get("alice"), "alice's position")
    assert (found["x_m"], found["y_m"], found["z_m"], found["frame"], found["source"]) == (
        12.5,
        -3.0,
        None,
        "map",
        "peer",
    )
    recording = alice.folder / "run.jsonl"
    with alice.client() as client, bob.client() as robot:
        client.request("record-start", path=str(recording))
        robot.request("set-position", x_m=40, y_m=2.25, z_m=-1, frame="odom", time_s=time.time() - 5.0)
        there = poll(lambda: places(alice).get("bob"), "bob's position")
        assert (there["x_m"], there["y_m"], there["z_m"], there["frame"]) == (40.0, 2.25, -1.0, "odom")
        assert 4.0 < there["age_s"] < 60.0
        client.request("record-stop")
    lines = [json.loads(line) for line in recording.read_text().splitlines()]
    assert {"at": "bob", "x": 40.0, "y": 2.25, "z": -1.0, "frame": "odom"}.items() <= next(
        line for line in lines if line.get("kind") == "place" and line["at"] == "bob"
    ).items()
    # the daemons' own topic is no topic of the programs'
    with bob.client() as robot:
        assert not [topic for topic in robot.request("topics")["topics"] if topic["name"].startswith("~mesh/")]


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"x_m": 1}, "y_m: expected a number of meters, found None"),
        ({"x_m": 1, "y_m": "2"}, "y_m: expected a number of meters, found '2'"),
        ({"x_m": 1, "y_m": True}, "y_m: expected a number of meters, found True"),
        ({"x_m": 1, "y_m": 2e7}, "y_m: expected a number of meters from -1e+07 to 1e+07"),
        ({"x_m": 1, "y_m": 2, "frame": "a b"}, "frame: expected a name of 1 to 64 bytes without spaces"),
        ({"x_m": 1, "y_m": 10**400}, "y_m: expected a number of meters, found 1000"),
        ({"x_m": 1, "y_m": 2, "frame": 7}, "frame: expected a name"),
        ({"x_m": 1, "y_m": 2, "time_s": "now"}, "time_s: expected a Unix time in seconds"),
    ],
)
def test_an_invalid_position_is_refused(pair: Pair, fields: dict[str, Any], complaint: str) -> None:
    with pair[1].client() as client, pytest.raises(MeshError, match="expected") as refused:
        client.request("set-position", **fields)
    assert refused.value.code == "bad-request"
    assert complaint in str(refused.value)


def test_a_meters_reading_reaches_local_subscribers_only(pair: Pair) -> None:
    alice, bob = pair
    with alice.client() as meter, alice.client() as display, bob.client() as other:
        display.subscribe(METER_TOPIC)
        other.subscribe(METER_TOPIC)
        poll(lambda: meter.request("publish-meter", b'{"advice": "GO"}')["subscribers"] or None, "the subscription")
        frame = display.next_frame(10.0)
        assert frame is not None
        assert frame[0]["topic"] == METER_TOPIC
        assert frame[1] == b'{"advice": "GO"}'
        assert other.next_frame(0.5) is None
