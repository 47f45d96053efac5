"""A source never uses a number twice, whatever its disk and its configuration went through."""

from __future__ import annotations

from dataclasses import replace

from tests.udp_mesh.core.logs.team import ARTIFACT, LogTeam
from tests.udp_mesh.core.pair import settings
from udp_mesh.core.settings import Topic

OTHER = replace(ARTIFACT, name="other")


def test_a_topic_that_becomes_a_log_again_after_a_restart_continues_its_numbers() -> None:
    team = LogTeam("base", "spot", topics=[ARTIFACT, OTHER])
    team.publish("spot", b"before")
    team.stop("spot")
    team.add(settings("spot", OTHER), log_store=team.stores["spot"])
    team.separate()
    team.nodes["spot"].apply(settings("spot", ARTIFACT, OTHER), team.now)
    team.publish("spot", b"after")
    team.meet("spot", "base", seconds=5)
    assert team.read("base") == [("spot", 1, b"before"), ("spot", 2, b"after")]


def test_items_no_program_took_are_delivered_when_their_topic_is_a_log_again() -> None:
    team = LogTeam("base", "spot", topics=[ARTIFACT, OTHER])
    team.stop("base")
    team.start("base", confirms=True)
    team.separate()
    team.publish("spot", b"artifact")
    team.meet("spot", "base", seconds=5)
    assert len(team.read("base")) == 1
    for topics in ((OTHER,), (ARTIFACT, OTHER)):
        team.nodes["base"].apply(settings("base", *topics, confirms=True), team.now)
        team.run(1)
    # A program may still be reading it.
    assert len(team.read("base")) == 1
    team.stop("base")
    team.add(settings("base", OTHER, confirms=True), log_store=team.stores["base"])
    team.run(1)
    assert len(team.read("base")) == 1
    team.nodes["base"].apply(settings("base", ARTIFACT, OTHER, confirms=True), team.now)
    team.run(1)
    assert len(team.read("base")) == 2


def test_peers_are_asked_again_for_a_topic_that_becomes_a_log_while_they_are_online() -> None:
    team = LogTeam("base", "spot", topics=[ARTIFACT, OTHER])
    team.stop("base")
    team.add(settings("base", OTHER), log_store=team.stores["base"])
    team.publish("spot", b"artifact")
    team.connect("base", "spot")
    team.run(5)
    team.nodes["base"].apply(settings("base", ARTIFACT, OTHER), team.now)
    team.run(3)
    assert team.read("base") == [("spot", 1, b"artifact")]


def test_numbers_that_others_have_are_skipped_when_the_disk_lost_the_items() -> None:
    team = LogTeam("base", "spot", topics=[ARTIFACT])
    for payload in (b"one", b"two", b"three"):
        team.publish("spot", payload)
    team.meet("spot", "base", seconds=5)
    # The disk said that it had written the last items and had not.
    store = team.stores["spot"]
    for item in [item for item in store.items if item.number > 1]:
        del store.items[item]
    team.stop("spot")
    team.start("spot")
    team.separate()
    team.meet("spot", "base", seconds=5)
    team.publish("spot", b"four")
    team.meet("spot", "base", seconds=5)
    assert team.read("base")[-1] == ("spot", 4, b"four")


def test_an_undeclared_topic_stays_out_of_the_logs() -> None:
    team = LogTeam("spot", topics=[ARTIFACT])
    team.publish("spot", b"artifact")
    team.stop("spot")
    team.add(settings("spot", Topic("artifact"), OTHER), log_store=team.stores["spot"])
    assert team.nodes["spot"].logs() == ()
