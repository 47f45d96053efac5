"""The page for Prometheus keeps to the text format's rules, whatever peers and topics are called.

The rules are those of the exposition format, version 0.0.4: one HELP and one TYPE per family, before its samples; a
family's samples stand together, each set of labels once; label values escape backslash, quote and line feed; counters
end in `_total` and are never negative.
"""

import asyncio
import re

import pytest

from tests.udp_mesh.core.pair import pair
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh.core.settings import Topic
from udp_mesh.daemon.metrics import render
from udp_mesh.daemon.metrics_server import MetricsServer
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
    assert ('peer="b",priority="5"', 1) in found["udp_mesh_queue_messages"]
    assert [labels for labels, _ in found["udp_mesh_topic_sent_bytes_total"]] == [
        'topic="a\\"b\\\\c"',
        'topic="line\\nfeed"',
        'topic="map"',
    ]


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
