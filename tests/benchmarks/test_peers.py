"""The compared transports: what those written from their wire lose and repair, and that each carries messages."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.link.laboratory import Laboratory, Link, laboratory
from benchmarks.peers import PEERS, nimbro, pound
from benchmarks.peers.erasure_code import repair_symbols, source_symbols
from benchmarks.trial import Load, run
from tests.udp_mesh.bridges.ros2_processes import expects_ros2

FAST = Link(rate=100e6, delay_ms=1.0, queue=1000)
# ends as soon as the bulk has arrived
FOUR_MESSAGES = Load(seconds=20.0, bulk_bytes=200_000, urgent_hz=20.0)
WRITTEN = ("nimbro_network's wire (UDP, FEC 0.5)", "nimbro_network's wire (bulk TCP BBR)", "Pound's wire")
ROS2 = (
    "ROS 2 Fast DDS (UDP)",
    "Cyclone DDS",
    # its two nodes take a quarter of a minute to find the receiver and to end
    pytest.param("ROS 2 Fast DDS (TCP BBR)", marks=pytest.mark.proof),
)
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")


@settings(max_examples=30)
@given(st.data())
def test_any_symbols_that_are_as_many_as_the_sources_give_the_sources_back(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 40))
    repairs = data.draw(st.integers(0, 25))
    sources = [data.draw(st.binary(min_size=8, max_size=8)) for _ in range(count)]
    symbols = dict(enumerate([*sources, *repair_symbols(sources, repairs)]))
    kept = data.draw(st.permutations(sorted(symbols)))[:count]
    assert source_symbols({index: symbols[index] for index in kept}, count) == sources


def test_forward_error_correction_repairs_as_many_losses_as_there_are_repair_symbols() -> None:
    message = random.Random(1).randbytes(50_000)
    sent = nimbro.datagrams(message, 7, b"/bulk", 0.25, random.Random(2))
    assert len(sent) == 36 + 9
    arrived = nimbro.Reassembly()
    assert [whole for datagram in sent[9:] if (whole := arrived.add(datagram)) is not None] == [message]
    too_few = nimbro.Reassembly()
    assert [too_few.add(datagram) for datagram in sent[10:]] == [None] * 35


def test_a_message_of_pound_is_lost_with_any_of_its_parts() -> None:
    message = random.Random(1).randbytes(50_000)
    sent = pound.parts(message, 7, 10)
    assert len(sent) == 36
    arrived = pound.Reassembly()
    assert [whole for datagram in sent if (whole := arrived.add(datagram)) is not None] == [message]
    without = pound.Reassembly()
    assert [without.add(datagram) for datagram in sent[1:]] == [None] * 35


@pytest.fixture(scope="module")
def lab() -> Iterator[Laboratory]:
    with laboratory(2) as made:
        yield made


@as_root
@pytest.mark.parametrize("name", WRITTEN)
def test_a_transport_written_from_its_wire_behavior_carries_bulk_and_urgent_messages(
    lab: Laboratory, name: str
) -> None:
    carries(lab, name)


@as_root
@pytest.mark.skipif(not expects_ros2(), reason="no ROS 2: run scripts/setup-ros2")
@pytest.mark.parametrize("name", ROS2)
def test_a_transport_of_ros_2_carries_bulk_and_urgent_messages_over_the_link(lab: Laboratory, name: str) -> None:
    carries(lab, name)


def carries(lab: Laboratory, name: str) -> None:
    assert name in PEERS
    seen = run(lab, name, FAST, FOUR_MESSAGES)
    assert seen.bulk[-1][1] == 200_000
    assert seen.urgent[0][0] == 0
    # over the emulated link, not through memory that the two hosts share
    assert seen.count.ports[0].in_bytes > 200_000
