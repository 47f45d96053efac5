"""A frame is JSON that every reader understands, whatever a device said."""

from __future__ import annotations

import json
import math

from meshctl.monitor.exposition import MetricFamily, exposition
from meshctl.monitor.frame import Frame


def test_half_a_surrogate_pair_is_replaced() -> None:
    frame = Frame.of({"time_s": 1.0, "name": "a\ud800b"})
    assert frame.json_text.encode() == b'{"time_s":1.0,"name":"a?b"}'
    assert frame.document == {"time_s": 1.0, "name": "a?b"}


def test_numbers_that_no_reader_holds_are_unknown() -> None:
    values = [math.inf, math.nan, 10**400, -(10**5000), 2**64 - 1, 12345678901234567890123, 1.5, True, "1" * 30]
    frame = Frame.of({"time_s": 1.0, "values": values})
    expected = [None, None, None, None, 2**64 - 1, None, 1.5, True, "1" * 30]
    assert frame.document["values"] == json.loads(frame.json_text)["values"] == expected


def test_a_metric_that_is_too_large_is_no_sample() -> None:
    family = MetricFamily("queue", "gauge", "Queue.")
    for node, value in (("b01", 10**400), ("b02", math.inf), ("b03", 7)):
        family.add(value, node=node)
    assert exposition([family]).splitlines()[2:] == ['queue{node="b03"} 7']
