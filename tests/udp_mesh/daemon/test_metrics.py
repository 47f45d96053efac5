"""The page for Prometheus keeps to the text format's rules, whatever peers and topics are called.

The rules are those of the exposition format, version 0.0.4: one HELP and one TYPE per family, before its samples; a
family's samples stand together, each set of labels once; label values escape backslash, quote and line feed; counters
end in `_total` and are never negative.
"""

import asyncio
import dataclasses
import json
import random
import re
from dataclasses import fields

import pytest

from tests.udp_mesh.core.pair import pair
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh.core.conditions import PeerConditions
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import Event, MessageDelivered, MessageId, PeerOffline
from udp_mesh.core.settings import Topic
from udp_mesh.core.versions.conditions import VersionCounters
from udp_mesh.daemon.interface import PING_TOPIC
from udp_mesh.daemon.latencies import Latencies
from udp_mesh.daemon.metrics import render
from udp_mesh.daemon.metrics_server import MetricsServer
from udp_mesh.daemon.radio_paths import MAX_AGE_S, parse_report
from udp_mesh.daemon.status import TopicCount

NAME = "[a-zA-Z_:][a-zA-Z0-9_:]*"
LABEL = r'[a-zA-Z_][a-zA-Z0-9_]*="(?:[^"\\\n]|\\[\\"n])*"'
SAMPLE = re.compile(rf"(?P<name>{NAME})(?:\{{(?P<labels>{LABEL}(?:,{LABEL})*)\}})? (?P<value>\S+)")


def families(page: str) -> dict[str, list[tuple[str, float]]]:
    """Family -> its samples' labels and values; fails where a rule is broken."""
    assert page.endswith("\n")
    helped: set[str] = set()
    kinds: dict[str, str] = {}
    found: dict[str, list[tuple[str, float]]] = {}
    for line in page[:-1].split("\n"):
        if about := re.fullmatch(rf"# (HELP|TYPE) ({NAME}) (.+)", line):
            what, name, text = about.groups()
            assert name not in found, "HELP and TYPE stand before the samples"
            if what == "HELP":
                assert name not in helped
                helped.add(name)
            else:
                assert name not in kinds
                assert text in ("counter", "gauge")
                kinds[name] = text
            continue
        sample = SAMPLE.fullmatch(line)
        assert sample is not None, line
        name, labels, value = sample["name"], sample["labels"] or "", float(sample["value"])
        assert name in found or name == list(kinds)[-1], "a family's samples stand together"
        assert labels not in [seen for seen, _ in found.get(name, [])], line
        assert (kinds[name] == "counter") == name.endswith("_total"), line
        assert value >= 0 or kinds[name] == "gauge", line
        found.setdefault(name, []).append((labels, value))
    assert helped == set(kinds) == set(found)
    return found


def test_the_metrics_page_follows_the_prometheus_text_format() -> None:
    both = pair(Topic("map", priority=5), Topic('a"b\\c', priority=6))
    for topic in ("map", 'a"b\\c'):
        both.a.send(topic, bytes(5000), destination="b", now=both.now)
    both.drop(both.a)
    counts = {"map": TopicCount(1, 5000), 'a"b\\c': TopicCount(1, 5000), "line\nfeed": TopicCount()}
    about = {"name": "a", "version": "1.0"}
    found = families(render(both.a.conditions(both.now), counts, {"wakeups": 7}, about=about, uptime_s=61.5))
    assert found["udp_mesh_info"] == [('name="a",version="1.0"', 1)]
    assert found["udp_mesh_uptime_seconds"] == [("", 61.5)]
    assert found["udp_mesh_peer_online"] == [('peer="b"', 1)]
    assert found["udp_mesh_build_info"] == [('version="1.0"', 1)]
    assert found["udp_mesh_peer_sent_bytes_total"] == [('peer="b"', both.a.conditions(both.now).peers[0].sent_bytes)]
    assert ('peer="b",priority="5"', 1) in found["udp_mesh_queue_messages"]
    assert [labels for labels, _ in found["udp_mesh_topic_sent_bytes_total"]] == [
        'topic="a\\"b\\\\c"',
        'topic="line\\nfeed"',
        'topic="map"',
    ]


def test_versions_are_counted_by_topic_at_both_ends() -> None:
    both = pair(Topic("map", delta=True), Topic("status"))
    rng = random.Random(1)
    grid = bytearray(rng.randbytes(5000))
    for _ in range(3):
        grid += rng.randbytes(50)
        for topic in ("map", "status"):
            both.a.send(topic, bytes(grid), destination="b", now=both.now)
        both.roundtrip(50)

    def page(node: Endpoint) -> dict[str, list[tuple[str, float]]]:
        versions = node.versions()
        text = render(node.conditions(both.now), {}, {}, versions=versions, about={}, uptime_s=1.0)
        found = {name: samples for name, samples in families(text).items() if name.startswith("udp_mesh_version_")}
        assert set(found) == {f"udp_mesh_version_{item.name}_total" for item in fields(VersionCounters)}
        return found

    sent, received = page(both.a), page(both.b)
    for found in (sent, received):
        assert {labels for samples in found.values() for labels, _ in samples} == {'topic="map"'}
    assert sent["udp_mesh_version_whole_sent_total"] == [('topic="map"', 1)]
    assert sent["udp_mesh_version_differences_sent_total"] == [('topic="map"', 2)]
    assert sent["udp_mesh_version_payload_bytes_sent_total"] == [('topic="map"', 5050 + 5100 + 5150)]
    assert 5050 < sent["udp_mesh_version_body_bytes_sent_total"][0][1] < 5400
    for name in ("payload_bytes", "body_bytes", "whole", "differences"):
        of_sender = sent[f"udp_mesh_version_{name}_sent_total"]
        assert received[f"udp_mesh_version_{name}_received_total"] == of_sender


def test_bytes_to_and_from_a_peer_grow_with_each_message() -> None:
    both = pair(Topic("map", priority=5))
    rng = random.Random(1)

    def after_message() -> tuple[PeerConditions, PeerConditions]:
        both.a.send("map", rng.randbytes(50_000), destination="b", now=both.now)
        both.roundtrip(200)
        return both.a.conditions(both.now).peers[0], both.b.conditions(both.now).peers[0]

    sent_before, received_before = after_message()
    sent, received = after_message()
    assert 50_000 <= sent.delivered_bytes - sent_before.delivered_bytes < sent.sent_bytes - sent_before.sent_bytes
    assert 50_000 < received.received_bytes - received_before.received_bytes < 60_000
    assert sent.sent_bytes - sent_before.sent_bytes < 60_000


def test_what_a_collector_reports_is_exported_while_it_is_recent() -> None:
    both = pair(Topic("map", priority=5))
    path = {
        "radio": "a-radio",
        "next_hop": 'b"02',
        "age_s": 1,
        "signal_dbm": -67,
        "margin_db": -1.5,
        "trend": "worsening",
    }
    paths = [{**path, "peer": "b", "change_db_per_s": -0.5}, {**path, "peer": "of no peer"}]
    heard = {"name": "b02", "radio": "a-radio", "age_s": 1, "signal_dbm": -67}
    report = {"source": "a-radio", "problem": "c-radio is down", "paths": paths, "neighbors": [heard, heard]}
    radio = parse_report(json.dumps(report).encode(), both.now)
    conditions = both.a.conditions(both.now)
    found = families(render(conditions, {}, {}, about={}, uptime_s=1.0, radio=radio))
    assert found["udp_mesh_radio_report_age_seconds"] == [("", 0.0)]
    assert found["udp_mesh_radio_problem"] == [("", 1.0)]
    assert found["udp_mesh_radio_path_info"] == [('peer="b",radio="a-radio",next_hop="b\\"02"', 1.0)]
    assert found["udp_mesh_radio_path_margin_db"] == [('peer="b"', -1.5)]
    assert found["udp_mesh_radio_path_trend_db_per_second"] == [('peer="b"', -0.5)]
    assert found["udp_mesh_radio_neighbor_signal_dbm"] == [('neighbor="b02",radio="a-radio"', -67.0)]
    unknown = {"noise_dbm", "bottleneck_bits_per_second", "quality_ratio"}
    assert not {f"udp_mesh_radio_path_{name}" for name in unknown} & set(found)
    later = dataclasses.replace(conditions, now=both.now + MAX_AGE_S + 1)
    silent = families(render(later, {}, {}, about={}, uptime_s=1.0, radio=radio))
    assert silent["udp_mesh_radio_report_age_seconds"] == [("", MAX_AGE_S + 1)]
    of_radio = {name for name in silent if name.startswith("udp_mesh_radio_")}
    assert of_radio == {"udp_mesh_radio_report_age_seconds", "udp_mesh_radio_problem"}
    without = families(render(conditions, {}, {}, about={}, uptime_s=1.0))
    assert not [name for name in without if name.startswith("udp_mesh_radio_")]


def test_latencies_are_a_cumulative_histogram_by_priority() -> None:
    seen: list[Event] = []
    latencies = Latencies({"estop": 0, "map": 5}.__getitem__)
    observe = latencies.watching(seen.append)
    for topic, seconds in (("estop", 0.004), ("estop", 0.005), ("estop", 0.03), ("map", 1000.0), (PING_TOPIC, 0.1)):
        observe(MessageDelivered(MessageId(1), "b", topic, seconds))
    observe(PeerOffline("b", left=False))
    assert len(seen) == 6
    both = pair(Topic("map", priority=5))
    page = render(both.a.conditions(both.now), {}, {}, about={}, uptime_s=1.0, latencies=latencies.by_priority)
    lines = [line for line in page.splitlines() if line.startswith("udp_mesh_delivery_latency_seconds")]
    name = "udp_mesh_delivery_latency_seconds"
    assert [line for line in lines if 'le="0.005"' in line or 'le="0.05"' in line or 'le="+Inf"' in line] == [
        f'{name}_bucket{{priority="0",le="0.005"}} 2',
        f'{name}_bucket{{priority="0",le="0.05"}} 3',
        f'{name}_bucket{{priority="0",le="+Inf"}} 3',
        f'{name}_bucket{{priority="5",le="0.005"}} 0',
        f'{name}_bucket{{priority="5",le="0.05"}} 0',
        f'{name}_bucket{{priority="5",le="+Inf"}} 1',
    ]
    assert f'{name}_count{{priority="0"}} 3' in lines
    assert f'{name}_sum{{priority="5"}} 1000' in lines


@pytest.mark.parametrize(
    ("request_line", "status", "body"),
    [
        ("GET /metrics HTTP/1.1", "200 OK", "up 1\n"),
        ("GET /metrics?collect=all HTTP/1.1", "200 OK", "up 1\n"),
        ("HEAD /metrics HTTP/1.1", "200 OK", ""),
        ("GET /metricsx HTTP/1.1", "404 Not Found", "GET /metrics\n"),
        ("POST /metrics HTTP/1.1", "404 Not Found", "GET /metrics\n"),
        ("GET", "404 Not Found", "GET /metrics\n"),
        ("", "404 Not Found", "GET /metrics\n"),
    ],
)
def test_the_metrics_server_answers_with_valid_http(request_line: str, status: str, body: str) -> None:
    async def ask() -> bytes:
        port = free_port()
        server = MetricsServer(("127.0.0.1", port), lambda: "up 1\n")
        await server.start()
        try:
            async with asyncio.timeout(WAIT_S):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(f"{request_line}\r\nHost: here\r\n\r\n".encode())
                answer = await reader.read()
                writer.close()
                await writer.wait_closed()
                return answer
        finally:
            await server.close()

    head, _, found = asyncio.run(ask()).decode().partition("\r\n\r\n")
    assert (head.split("\r\n")[0], found) == (f"HTTP/1.1 {status}", body)
    assert f"Content-Length: {len(body) or len('up 1') + 1}" in head
