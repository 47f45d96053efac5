"""Preflight is a go only when every check is, and each no-go has its reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from ipaddress import IPv4Address
from typing import Any

from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Robot, Role
from meshctl.robots.facts import RobotFacts, ServiceFacts
from meshctl.status import Check, preflight
from meshctl.status.emergency_stop import StopResult, parse_outcomes, send, stop_plan
from meshctl.status.filters import select_devices
from meshctl.status.json_output import preflight_json
from meshctl.status.pings import Pings, parse_pings, pings_of
from meshctl.status.text import preflight_text
from meshctl.status.values import Alarm, Level, NoAnswer
from tests.meshctl.status.fleets import HEALTHY, NOW, TEAM, robot_facts, seen, status_of

KNOWN = {"b02": LastKnown("b02", NOW - 60, {})}
DELIVERED = Pings({("station", "rover"): 0.01, ("rover", "station"): 0.02})


def checks(
    fleet: Fleet, robots: Mapping[str, RobotFacts] = TEAM, pings: Pings | None = DELIVERED, **other: Any
) -> dict[str, Check]:
    status = status_of(fleet, robots=robots, **{"known": KNOWN, **other})
    return {check.name: check for check in preflight(fleet, status, pings)}


def stopped(found: Mapping[str, Check]) -> list[str]:
    return [check.name for check in found.values() if not check.is_go]


def test_a_healthy_team_is_a_go(fleet: Fleet) -> None:
    found = checks(fleet)
    assert stopped(found) == []
    assert preflight_text(found.values()).splitlines()[-1] == "GO"
    assert "the slowest rover to station in 20 ms" in found["delivery"].reason
    assert preflight_json(found.values())["go"]


def test_a_robot_left_on_the_shelf_is_listed_and_does_not_block(fleet: Fleet) -> None:
    found = checks(fleet)
    assert "not taking part: shelf (carried)" in found["robot radios"].reason
    assert "not taking part: shelf" in found["daemons"].reason


def test_a_robot_with_the_legacy_program_is_named_and_does_not_block(fleet: Fleet) -> None:
    husky = Robot("husky", (), fielded=IPv4Address("10.42.0.20"))
    robots = {**fleet.robots, "husky": husky, "cart": Robot("cart", ())}
    # only robots with a computer are asked
    asked = status_of(fleet, known=KNOWN)
    found = {check.name: check for check in preflight(replace(fleet, robots=robots), asked, DELIVERED)}
    assert stopped(found) == []
    assert "husky still runs the legacy program, cart has no computer" in found["daemons"].reason


def test_a_carried_beacon_never_seen_is_a_no_go(fleet: Fleet) -> None:
    found = checks(fleet, known={})
    assert stopped(found) == ["beacons"]
    assert "b02: never seen" in found["beacons"].reason


def test_a_robot_whose_radio_is_silent_is_a_no_go(fleet: Fleet) -> None:
    status = status_of(fleet, {name: HEALTHY[name] for name in ("base", "b01")}, known=KNOWN)
    assert stopped({check.name: check for check in preflight(fleet, status, DELIVERED)}) == ["robot radios"]


def test_a_robot_whose_daemon_is_down_is_a_no_go_with_the_reason(fleet: Fleet) -> None:
    rover = replace(TEAM["rover"], service=ServiceFacts("failed", "enabled", 0, "exit-code"), status={}, peers=())
    found = checks(fleet, {**TEAM, "rover": rover}, Pings())
    assert "rover: its daemon is failed (exit-code)" in found["daemons"].reason
    assert {"daemons", "delivery"} <= set(stopped(found))


def test_a_radio_with_no_path_or_a_zero_quality_path_is_a_no_go(fleet: Fleet) -> None:
    islands = {
        **HEALTHY,
        "base": seen("base", {"rover": 1}),
        "b01": seen("b01", {}),
        "rover": seen("rover", {"base": 1}),
    }
    found = checks(fleet, observations=islands)
    assert "links" in stopped(found)
    assert "rover: path to the base has 0% quality" in found["links"].reason
    islands = {**HEALTHY, "b01": seen("b01", {"rover": 200})}
    islands["base"] = seen("base", {"b02": 200})
    assert "no path through the mesh" in checks(fleet, observations=islands)["links"].reason


def test_robots_that_do_not_hear_each_other_are_a_no_go(fleet: Fleet) -> None:
    found = checks(fleet, {**TEAM, "station": robot_facts("station")})
    assert found["peers"].reason == "station does not hear rover"


def test_an_undelivered_test_message_is_a_no_go(fleet: Fleet) -> None:
    found = checks(fleet, pings=Pings({("station", "rover"): 0.01}, {("rover", "station"): "no-answer"}))
    assert stopped(found) == ["delivery"]
    assert found["delivery"].reason == "rover to station: no-answer"


def test_an_urgent_topic_that_is_not_declared_is_a_no_go(fleet: Fleet) -> None:
    found = checks(fleet, {**TEAM, "rover": replace(TEAM["rover"], topics=TEAM["rover"].topics[1:])})
    assert found["urgent topics"].reason == "rover: estop is not declared"


def test_missing_secrets_are_a_no_go_with_the_reason(fleet: Fleet) -> None:
    found = checks(fleet, unrendered={"base": "env:KEY is not set"})
    assert stopped(found) == ["configuration"]
    assert "env:KEY is not set" in found["configuration"].reason


def test_a_check_without_any_answer_is_a_no_go(fleet: Fleet) -> None:
    status = status_of(fleet, {}, {}, known=KNOWN)
    found = {check.name: check for check in preflight(fleet, status, Pings())}
    assert not any(check.is_go for check in found.values() if check.name != "beacons")
    assert found["radios"].reason == "cannot check: no radio answers"
    assert found["one release"].reason == found["computers"].reason == "cannot check: no computer answers"
    assert found["queues"].reason == "cannot check: no daemon answers"


def test_a_check_with_partial_answers_shows_their_number(fleet: Fleet) -> None:
    status = status_of(fleet, {name: HEALTHY[name] for name in ("base", "b01")}, known=KNOWN)
    found = {check.name: check for check in preflight(fleet, status, DELIVERED)}
    assert found["identity"].reason == "every radio is the expected device (2 of 3 answer)"


def test_a_busy_computer_is_a_note_and_does_not_block(fleet: Fleet) -> None:
    rover = TEAM["rover"]
    busy = replace(rover, computer=replace(rover.computer, load=(40.0, 9.0, 3.0)))
    assert stopped(checks(fleet, {**TEAM, "rover": busy})) == []


def test_unqueried_robots_are_shown_as_not_checked(fleet: Fleet) -> None:
    status = replace(
        status_of(fleet, robots={}, known=KNOWN), robots=(), alarms=(Alarm(Level.NOTE, "robots-unasked", "not asked"),)
    )
    found = {check.name: check for check in preflight(fleet, status)}
    assert stopped(found) == []
    assert (found["robots"].reason, found["robots"].is_checked) == ("not asked", False)
    shown = preflight_text(found.values()).splitlines()
    assert shown[-1] == "GO (radios only)"
    assert [line for line in shown if line.startswith("?    ")] == ["?      robots         not asked"]
    written = preflight_json(found.values())
    assert (written["go"], written["verdict"]) == (True, "GO (radios only)")
    assert [check["check"] for check in written["checks"] if not check["checked"]] == ["robots"]


def test_an_unmeasured_path_is_neither_go_nor_no_go(fleet: Fleet) -> None:
    unmeasured = {name: seen(name, {}) for name in HEALTHY}
    status = status_of(fleet, unmeasured, known=KNOWN)
    status = replace(status, nodes=tuple(replace(node, quality=None, alarms=(), neighbors=()) for node in status.nodes))
    found = {check.name: check for check in preflight(fleet, status, DELIVERED)}
    assert (found["links"].is_go, found["links"].is_checked) == (True, False)
    assert preflight_text(found.values()).splitlines()[-1] == "GO (not checked: links)"


def test_pings_are_parsed_by_line_and_missing_results_are_failures() -> None:
    text = '{"peer": "a", "round_trip_s": 0.5}\nnoise\n{"peer": "b", "error": "no-answer"}\n[1]\n{"peer": "c"}\n'
    answers = parse_pings(text, ("a", "b", "c", "d"))
    assert answers == {"a": 0.5, "b": "no-answer", "c": "no answer", "d": "not sent"}
    pings = pings_of({"x": answers})
    assert pings.round_trips_s == {("x", "a"): 0.5}
    assert pings.failed["x", "b"] == "no-answer"


def selected(fleet: Fleet, *words: str) -> tuple[Check, ...]:
    """The checks of what `words` select, while rover is unreachable and b02 was never seen."""
    whole = status_of(fleet, {name: HEALTHY[name] for name in ("base", "b01")}, TEAM, known={})
    chosen = select_devices(fleet, words, lambda path: path).devices_of(whole)
    left_out = [one.title for one in whole if one not in tuple(chosen)]
    return preflight(fleet, chosen, DELIVERED, left_out)


def test_a_go_for_a_selection_lists_what_was_not_checked(fleet: Fleet) -> None:
    found = {check.name: check for check in selected(fleet, "base", "b01")}
    assert stopped(found) == []
    assert "not selected: station computer, b02, rover, rover computer" in found["others"].reason
    assert "no robot is selected" in found["robots"].reason
    assert preflight_text(found.values()).splitlines()[-1] == "GO (not checked: robots, others)"


def test_a_selected_device_that_is_not_ready_is_a_no_go(fleet: Fleet) -> None:
    assert "beacons" in [check.name for check in selected(fleet, "base", "b02") if not check.is_go]


def test_one_selected_robot_has_no_peer_for_test_messages(fleet: Fleet) -> None:
    found = {check.name: check for check in selected(fleet, "base", "robot:station")}
    for name in ("peers", "delivery"):
        assert found[name].is_go
        assert not found[name].is_checked


def test_an_emergency_stop_goes_from_its_source_to_the_active_robots(fleet: Fleet) -> None:
    plan = stop_plan(fleet, ["station", "rover"])
    assert plan is not None
    assert (plan.topic.name, plan.source, plan.destinations) == ("estop", "station", ("rover",))
    assert stop_plan(replace(fleet, topics=()), ["rover"]) is None


def test_an_emergency_stop_is_a_go_only_if_every_robot_acknowledges_it(fleet: Fleet) -> None:
    lines = '{"event": "outcome", "peer": "rover", "outcome": "delivered"}\nnoise\n'
    lines += '{"event": "outcome", "peer": "spot", "outcome": "expired", "reason": "deadline"}\n'
    status = status_of(fleet, known=KNOWN)
    found = {
        names: {check.name: check for check in preflight(fleet, status, DELIVERED, (), parse_outcomes(lines, names))}
        for names in (("rover",), ("rover", "spot", "uav"), ())
    }
    assert found[("rover",)]["emergency stop"].is_go
    assert "acknowledged by rover" in found[("rover",)]["emergency stop"].reason
    reason = found[("rover", "spot", "uav")]["emergency stop"].reason
    assert reason == "spot: expired (deadline); uav: no acknowledgment"
    assert not found[()]["emergency stop"].is_go
    # none was requested
    assert "emergency stop" not in checks(fleet)


def test_a_robot_whose_daemon_is_down_has_not_acknowledged_the_emergency_stop(fleet: Fleet) -> None:
    plan = stop_plan(fleet, ["station"], ["rover"])
    assert plan is not None
    assert (plan.destinations, plan.silent) == ((), ("rover",))
    # nothing is run on the source: it has nobody to send it to
    result = preflight(fleet, status_of(fleet, known=KNOWN), DELIVERED, (), send(None, plan, b"stop"))  # type: ignore[arg-type]
    assert [(check.name, check.reason) for check in result if not check.is_go] == [
        ("emergency stop", "rover: not sent: its daemon does not answer")
    ]


def test_what_only_an_installed_daemon_shows_is_not_a_go_without_one(fleet: Fleet) -> None:
    bare = {name: replace(facts, release="", status={}, service=ServiceFacts()) for name, facts in TEAM.items()}
    found = checks(fleet, bare)
    for name in ("daemons", "one release", "keys", "ROS bridges", "peers", "topics"):
        assert not found[name].is_go, name
    assert found["one release"].reason == "cannot check: no computer has udp_mesh"


def test_an_emergency_stop_that_could_not_be_sent_is_a_no_go(fleet: Fleet) -> None:
    result = preflight(
        fleet, status_of(fleet, known=KNOWN), DELIVERED, (), StopResult(problem="station cannot send it")
    )
    assert [(check.name, check.reason) for check in result if not check.is_go] == [
        ("emergency stop", "station cannot send it")
    ]


def test_the_base_of_each_site_that_takes_part_must_answer(fleet: Fleet) -> None:
    south = {name: replace(fleet.nodes[name], site="south") for name in ("b01", "rover")}
    nodes = {**fleet.nodes, **south, "b01": replace(south["b01"], role=Role.BASE)}
    sites = replace(fleet, nodes=nodes)
    whole = status_of(sites, HEALTHY, known=KNOWN)
    found = next(check for check in preflight(sites, whole) if check.name == "base")
    assert (found.is_go, found.reason) == (True, "base answers, b01 answers")
    there = replace(whole, nodes=tuple(node for node in whole.nodes if node.node.site == "south"))
    found = next(check for check in preflight(sites, there) if check.name == "base")
    assert (found.is_go, found.reason) == (True, "b01 answers")
    silent = {name: HEALTHY[name] for name in HEALTHY if name != "b01"}
    lost = status_of(sites, silent, known=KNOWN, silent={"b01": NoAnswer("no answer to connect within 5 s")})
    found = next(check for check in preflight(sites, lost) if check.name == "base")
    assert (found.is_go, found.reason) == (False, "b01 does not answer: no answer to connect within 5 s")
