"""Readings of the placement meter reach frames and pages, from a real daemon, and disappear when they are old."""

from __future__ import annotations

import json
import threading
from pathlib import Path

from meshctl.monitor.frame import frame_of
from meshctl.monitor.meters import MAX_AGE_S, MeterReadings
from tests.meshctl.monitor.documents import status
from tests.udp_mesh.daemon.processes import two_daemons
from tests.waiting import until

READING = {"robot": "rover", "advice": "DROP SOON", "meters_left": 12.5, "margin_db": None}


def test_a_reading_of_the_local_daemon_becomes_part_of_a_frame() -> None:
    heard: list[str] = []
    with two_daemons() as (alice, _), alice.client() as meter:
        readings = MeterReadings(alice.socket, lambda: heard.append("reading"))
        thread = threading.Thread(target=readings.run)
        thread.start()
        try:
            text = json.dumps(READING).encode()
            until(lambda: meter.request("publish-meter", text)["subscribers"] > 0, "the subscription")
            until(lambda: bool(heard), "the reading")
            document = frame_of(status(), time_s=1.0, meters=readings.current()).document
        finally:
            readings.stop()
            thread.join(30)
    assert document["meters"] == {"rover": READING}


def test_old_and_damaged_readings_are_left_out() -> None:
    now_s = [0.0]
    readings = MeterReadings(Path("unused"), monotonic=lambda: now_s[0])
    for payload in (b"{", b"[" * 100_000, b"[]", b'{"robot": 7}', json.dumps(READING).encode()):
        readings.take(payload)
    now_s[0] = MAX_AGE_S
    assert readings.current() == {"rover": READING}
    now_s[0] += 0.1
    assert readings.current() == {}
    assert "meters" not in frame_of(status(), time_s=1.0, meters=readings.current()).document
