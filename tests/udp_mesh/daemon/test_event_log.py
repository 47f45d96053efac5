"""Events fill no disk with their lines."""

from __future__ import annotations

import logging

import pytest

from udp_mesh.daemon.event_log import MAX_LINES, EventLog


def test_many_events_of_a_kind_are_counted_and_others_logged(caplog: pytest.LogCaptureFixture) -> None:
    now = 0.0
    events = EventLog(lambda: now)
    with caplog.at_level(logging.INFO):
        for number in range(10 * MAX_LINES):
            now = number * 0.01
            events.write({"event": "log-item-dropped", "number": number, "reason": "disk error"})
        events.write({"event": "peer-offline", "peer": "bob"})
        now = 70.0
        for number in range(2):
            events.write({"event": "log-item-dropped", "number": number, "reason": "full"})
    lines = [record.getMessage() for record in caplog.records]
    assert lines[0] == "log-item-dropped number=0 reason=disk error"
    assert len(lines) == MAX_LINES + 3
    assert lines[-3:] == [
        "peer-offline peer=bob",
        f"log-item-dropped number=0 reason=full unlogged={9 * MAX_LINES}",
        "log-item-dropped number=1 reason=full",
    ]
