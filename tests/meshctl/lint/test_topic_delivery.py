"""Where differences cannot work or save nothing (MC719, MC720), and that udp_mesh does what these rules say of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.lint.rules import topic_delivery
from meshctl.regdb import SHIPPED, load
from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.settings import Topic
from udp_mesh.core.versions.encoding import MIN_BASE_BYTES
from udp_mesh.core.versions.sent import MAX_BYTES_PER_S

_REGDB = load(SHIPPED)


def findings(directory: Path, fragment: str) -> tuple[list[Diagnostic], list[str]]:
    """What lint says of an example, and the lines of its inventory."""
    example = Example(fragment)
    path = write(example, directory)
    return list(check_path(path, _REGDB, environment(example)).diagnostics), path.read_text().splitlines()


@pytest.mark.parametrize(
    ("fragment", "path", "message", "expected", "found"),
    [
        (
            "topics: {map: {type: sensor_msgs/msg/CompressedImage, delta: true}}",
            "topics.map.delta",
            "compressed already",
            "false for this type",
            "sensor_msgs/msg/CompressedImage",
        ),
        (
            "topics: {map: {delta: true, size_bytes: 31}}",
            "topics.map.delta",
            "every message is sent whole",
            "messages of at least 32 bytes",
            "31 bytes",
        ),
        (
            "topics: {telemetry: {delta: true}}",
            "topics.telemetry.delta",
            "broadcast whole, in one datagram",
            "named destinations, or false",
            "400 bytes to all",
        ),
        (
            "topics: {map: {delta: true, delta_bytes: 19999}}",
            "topics.map.delta_bytes",
            "every message is sent whole",
            "at least 20000 (size_bytes)",
            "19999",
        ),
        (
            "topics: {map: {delta: true, rate_hz: 900, rate_limit_bytes_per_s: 20000, keep_last: 1}}",
            "topics.map.delta",
            "part of the messages is sent whole",
            "at most 33554432 bytes/s with their bases",
            "900 Hz x 2 x 20000 bytes",
        ),
    ],
)
def test_differences_without_gain_are_reported_at_their_line(
    fragment: str, path: str, message: str, expected: str, found: str, tmp_path: Path
) -> None:
    (only,), lines = findings(tmp_path, fragment)
    assert (only.code, only.severity.value, only.path) == ("MC720", "warning", path)
    assert (only.message, only.expected, only.found) == (message, expected, found)
    assert lines[only.position.line - 1].strip().startswith(path.rpartition(".")[2] + ":")


def test_a_default_delta_bytes_below_the_size_is_reported_at_the_topic(tmp_path: Path) -> None:
    big = "{delta: true, size_bytes: 20000000, rate_hz: 0.1, rate_limit_bytes_per_s: 20000, keep_last: 1}"
    (only,), lines = findings(tmp_path, f"topics: {{map: {big}}}")
    assert (only.code, only.found) == ("MC720", "16777216")
    assert lines[only.position.line - 1].strip() == "map:"


@pytest.mark.parametrize(
    "fragment",
    [
        # keep_last, best effort and an outbox work with differences
        "topics: {map: {delta: true, keep_last: 1}}",
        "topics: {map: {delta: true, reliable: false}}",
        "topics: {map: {delta: true, outbox: last}}",
        # an unknown size
        "topics: {commands: {delta: true}}",
        # to all, but larger than a datagram, or to each by itself
        "topics: {map: {delta: true, destinations: [all], size_bytes: 1400}}",
        "{topics: {telemetry: {delta: true}}, udp_mesh: {broadcast: false}}",
        # without delta
        "topics: {video: {type: sensor_msgs/CompressedImage, delta_bytes: 1}}",
    ],
)
def test_differences_that_work_are_not_reported(fragment: str, tmp_path: Path) -> None:
    assert [found.code for found in findings(tmp_path, fragment)[0]] == []


def test_differences_of_a_log_are_an_error_like_its_other_contradictions(tmp_path: Path) -> None:
    (only,), lines = findings(tmp_path, "topics: {artifacts: {log: {}, delta: true, size_bytes: 20}}")
    assert (only.code, only.path, only.expected) == ("MC719", "topics.artifacts.delta", "no delta beside log")
    assert lines[only.position.line - 1].strip() == "delta: true"


def test_the_limits_in_the_rule_are_those_of_the_transport() -> None:
    assert topic_delivery._MIN_BASE_BYTES == MIN_BASE_BYTES
    assert topic_delivery._COMPARED_BYTES_PER_S == MAX_BYTES_PER_S


@pytest.mark.parametrize("size", [topic_delivery._BROADCAST_BYTES - len("map"), 1500])
def test_a_message_to_all_is_a_version_only_if_it_exceeds_a_datagram(size: int) -> None:
    made = World(seed=3)
    for name in "abc":
        made.add(settings(name, Topic("map", delta=True)))
    made.run(3.0)
    for number in range(3):
        made.send("a", "map", bytes([number]) * size)
        made.run(1.0)
    versions = made.nodes["a"].versions()
    if size == 1500:
        assert versions[0].counters.differences_sent == 2 * 2
    else:
        assert versions == ()
