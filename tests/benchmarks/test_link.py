"""The emulated link: its counters are exact, and each setting has its effect."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import pytest

from benchmarks.link.laboratory import Laboratory, LaboratoryError, laboratory

RECEIVE = """
import socket, sys
with socket.socket(type=socket.SOCK_DGRAM) as s:
    s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    s.bind(("0.0.0.0", 9000))
    print("bound", flush=True)
    while (data := s.recv(2048)) != b"end":
        sys.stdout.write(data.decode() + "\\n")
"""
SEND = """
import socket, sys
with socket.socket(type=socket.SOCK_DGRAM) as s:
    for number in range(int(sys.argv[2])):
        s.sendto(str(number).encode().ljust(1000), (sys.argv[1], 9000))
"""
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")


@pytest.fixture(scope="module")
def lab() -> Iterator[Laboratory]:
    with laboratory(2) as made:
        yield made


def send(lab: Laboratory, count: int) -> None:
    lab.run(0, ["python3", "-c", SEND, lab.addresses[1], str(count)])


def settled(lab: Laboratory, count: int) -> None:
    """Wait until the link has handled every frame."""
    for _ in range(3000):
        counted = lab.count()
        if counted.ports[0].in_frames >= count and not counted.in_flight:
            return
        time.sleep(0.01)
    raise AssertionError(f"{count} frames were sent, the link counted {lab.count()}")


def test_a_clean_link_carries_every_frame_and_its_airtime_is_bytes_over_rate(lab: Laboratory) -> None:
    lab.set(rate=1e9, delay_ms=0, loss=0, queue=10000)
    lab.reset()
    send(lab, 200)
    settled(lab, 200)
    count = lab.count()
    assert count.ports[1].out_frames == 200
    assert count.ports[1].out_bytes == 200 * 1028
    # with that of the receiver's replies, port unreachable, whose number the kernel limits
    assert count.airtime_s == pytest.approx(200 * 1028 * 8 / 1e9, rel=0.02)


def test_retries_recover_the_configured_loss_at_the_cost_of_airtime(lab: Laboratory) -> None:
    lab.set(rate=1e9, delay_ms=0, loss=0.3, queue=10000, attempts=1)
    lab.reset()
    send(lab, 2000)
    settled(lab, 2000)
    assert lab.count().ports[0].losses == pytest.approx(600, rel=0.2)
    once = lab.count().airtime_s
    lab.set(attempts=10)
    lab.reset()
    send(lab, 2000)
    settled(lab, 2000)
    assert lab.count().ports[0].losses <= 2
    assert lab.count().airtime_s == pytest.approx(once / 0.7, rel=0.1)


def test_a_link_that_is_down_carries_nothing_and_a_full_queue_drops(lab: Laboratory) -> None:
    lab.set(rate=1e9, delay_ms=0, loss=0, attempts=1, up=0, queue=10000)
    lab.reset()
    send(lab, 50)
    settled(lab, 50)
    assert lab.count().ports[1].out_frames == 0
    lab.set(up=1, rate=8e5, queue=5)
    lab.reset()
    send(lab, 100)
    settled(lab, 100)
    counted = lab.count().ports[0]
    assert counted.queue_drops > 0
    assert counted.max_waiting <= 5


def test_an_unknown_setting_is_refused_by_name(lab: Laboratory) -> None:
    with pytest.raises(LaboratoryError, match="unknown setting speed"):
        lab.set(speed=1)


def test_hosts_out_of_reach_of_each_other_lose_every_frame(lab: Laboratory) -> None:
    lab.set(rate=1e9, delay_ms=0, loss=0, queue=10000, up=1)
    for groups, delivered, dropped in (([[0], [1]], 0, 50), ([[0]], 0, 50), ([[0, 1]], 50, 0)):
        lab.bring_together(*groups)
        lab.reset()
        send(lab, 50)
        settled(lab, 50)
        sender, receiver = lab.count().ports
        assert sender.down_drops == dropped
        assert receiver.out_frames == delivered
