"""Recognition of ARP frames, their airtime, and the table."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.arp_airtime import air_us, table
from benchmarks.in_machine.overhear_arp import kind_of
from benchmarks.reconvergence_udp_mesh import airtime_us

ETHERNET = b"\xff" * 6 + b"\x02" * 6
ARP, IPV4 = ETHERNET + b"\x08\x06" + bytes(28), ETHERNET + b"\x08\x00" + bytes(40)


@pytest.mark.parametrize(
    ("packet", "kind"),
    [
        (b"\x00" + bytes(23), "ogm"),
        (b"\x01\x0f\x32\x00" + bytes(10) + ARP, "broadcast"),
        (b"\x01\x0f\x32\x00" + bytes(10) + IPV4, ""),
        (b"\x40\x0f\x32\x00" + bytes(6) + ARP, "unicast"),
        (b"\x42\x0f\x32\x00" + bytes(12) + b"\x01\x00" + ARP, "unicast"),
        (b"\x42\x0f\x32\x00" + bytes(12) + b"\x02\x00" + ARP, "table"),
        (b"\x43" + bytes(60), ""),
        (b"\x01", ""),
        (b"", ""),
    ],
)
def test_arp_frames_are_classified_by_their_batman_packet_type(packet: bytes, kind: str) -> None:
    assert kind_of(packet) == kind


def result(scene: str, *, is_on: bool, requests: int = 10) -> dict[str, Any]:
    overheard = [
        {"kind": "broadcast", "rate": 24, "bytes": 90, "count": 180},
        {"kind": "unicast", "rate": 0, "bytes": 84, "count": 20},
        {"kind": "ogm", "rate": 24, "bytes": 80, "count": 300},
    ]
    return {"table": is_on, "scene": scene, "seconds": 30, "nodes": 6, "requests": requests, "overheard": overheard}


def test_unicast_airtime_includes_the_acknowledgement() -> None:
    one = result("pings", is_on=False)
    assert air_us(one, "broadcast") == 180 * airtime_us(24, 90, "ogm")
    assert air_us(one, "unicast") == 20 * airtime_us(0, 84, "probe")


def test_a_row_is_per_minute_and_missing_results_are_marked() -> None:
    lines = table([result("pings", is_on=False), result("pings", is_on=False, requests=20)]).splitlines()
    assert next(line for line in lines if line.startswith("| pings | off")).startswith(
        "| pings | off | 2 | 30 | 360 | 40 | 35760 | "
    )
    assert "| pings | on | 0 | not measured | - | - | - | - | - |" in lines
