"""A frame is JSON that every reader understands, whatever a device said."""

from __future__ import annotations

import json
import math

from meshctl.monitor.exposition import MetricFamily, exposition
from meshctl.monitor.frame import Frame, links_of
from meshctl.monitor.metrics import render_metrics
from meshctl.monitor.sampler import reported_positions


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


def test_the_age_of_a_link_is_unknown_where_one_of_its_parts_is() -> None:
    def age_s(node: float | None, heard: float | None) -> object:
        status = {"nodes": [{"name": "b01", "age_s": node, "neighbours": [{"name": "b02", "age_s": heard}]}]}
        (link,) = links_of(status)
        return link["age_s"]

    assert [age_s(1.5, 0.25), age_s(None, 0.25), age_s(1.5, None), age_s(0, 0)] == [1.75, None, None, 0]


def test_half_a_position_is_none() -> None:
    positions = ({"x_m": 1.0}, {"y_m": 1.0}, {"x_m": 1.0, "y_m": None}, None)
    status = {"robots": [{"name": str(index), "position": one} for index, one in enumerate(positions)]}
    assert reported_positions(status) == {}


def test_metrics_have_what_is_known_now_alone() -> None:
    measured = {"round_trip_s": 0.01, "loss": 0.0, "capacity_bits_per_s": 1e6, "outbox_messages": 2}
    peers = [{"name": "base", "online": False, **measured}, {"name": "husky", "online": True, **measured}]
    stranger = {"code": "stranger", "level": "note", "text": "found 10.42.0.9"}
    status = {"robots": [{"name": "spot", "peers": peers}], "alarms": [stranger], "nodes": [{"name": "b01"}]}
    lines = render_metrics(Frame.of({"time_s": 1.0, "status": status})).splitlines()
    known = [line.split("{")[0] for line in lines if 'peer="base"' in line]
    assert known == ["meshctl_robot_peer_online", "meshctl_robot_peer_outbox_messages"]
    assert 'meshctl_robot_peer_loss_ratio{robot="spot",peer="husky"} 0' in lines
    (alarm,) = [line for line in lines if line.startswith("meshctl_alarm{")]
    assert alarm.startswith('meshctl_alarm{device="fleet",code="stranger",level="note"')
