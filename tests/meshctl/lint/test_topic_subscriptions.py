"""`always` where it changes nothing (MC725), and that udp_mesh sends such topics unread, as the rule says."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.lint.rules import topic_delivery
from tests.meshctl.lint.test_topic_delivery import findings
from tests.udp_mesh.core.subscriptions.team import config, met, received
from udp_mesh.core.settings import Outbox, Rates, Topic


@pytest.mark.parametrize(
    ("fragment", "message"),
    [
        ("topics: {stop: {priority: 3, always: true}}", "sent in any case: priority 3 is urgent"),
        ("topics: {map: {outbox: last, always: true}}", "sent in any case: its outbox is last"),
        ("topics: {artifacts: {priority: 4, log: {}, always: true}}", "sent in any case: it is a shared log"),
        (
            "{topics: {telemetry: {always: true}}, udp_mesh: {selective: false}}",
            "sent in any case: udp_mesh.selective is false",
        ),
    ],
)
def test_always_without_effect_is_reported_at_its_line(fragment: str, message: str, tmp_path: Path) -> None:
    (only,), lines = findings(tmp_path, fragment)
    assert (only.code, only.severity.value, only.message) == ("MC725", "warning", message)
    assert (only.expected, only.found) == ("false", "true")
    assert lines[only.position.line - 1].strip() == "always: true"


@pytest.mark.parametrize(
    "fragment", ["topics: {telemetry: {priority: 4, always: true}}", "topics: {commands: {priority: 3}}"]
)
def test_always_with_an_effect_is_not_reported(fragment: str, tmp_path: Path) -> None:
    assert [found.code for found in findings(tmp_path, fragment)[0]] == []


def test_the_urgent_levels_of_the_rule_are_those_of_the_transport() -> None:
    assert Rates().urgent_priority == topic_delivery._URGENT_PRIORITY


@pytest.mark.parametrize("topic", [Topic("t", priority=3), Topic("t", outbox=Outbox.LAST), Topic("t", always=True)])
def test_udp_mesh_sends_such_a_topic_unread(topic: Topic) -> None:
    world = met(config("a", topic), config("b", topic))
    world.send("a", "t", b"data", "b")
    world.run(2.0)
    assert received(world, "b", "t") == [b"data"]
