"""Thin links in the status: links with their budgets, who is reached only there, and what needs an operator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tests.udp_mesh.core.thin.fleet import ThinFleet
from udp_mesh.cli.thin_view import alarms, thin_view
from udp_mesh.core.thin.conditions import ThinConditions
from udp_mesh.core.thin.settings import ThinLinkSettings
from udp_mesh.daemon.metrics import render
from udp_mesh.daemon.status import thin_json

LINK = ThinLinkSettings("lora", 5_470.0, frame_bytes=120, duty_cycle=0.1)


@pytest.fixture(scope="module")
def conditions() -> ThinConditions:
    fleet = ThinFleet("base", "husky", link=LINK)
    assert fleet.run(600, fleet.met)
    return fleet.conditions("base")


def fields(conditions: ThinConditions, **failures: str) -> dict[str, Any]:
    found = thin_json(conditions, failures, {"xbee": "the channel is busy"} if failures else {})
    assert found is not None
    return found


def test_a_link_and_who_is_reached_only_there(conditions: ThinConditions) -> None:
    text = "\n".join(thin_view(fields(conditions)))
    assert "360 s in " in text
    assert "husky" in text
    assert "ONLY HERE" in text
    assert "THIN LINK" not in text


def test_nothing_is_wrong_at_first(conditions: ThinConditions) -> None:
    assert alarms(fields(conditions)) == []


def test_each_alarm_says_what_is_wrong_and_what_to_do(conditions: ThinConditions) -> None:
    [link], [peer] = conditions.links, conditions.peers
    wrong = replace(
        conditions,
        links=(replace(link, rejecting_s=1800.0, failed_authentications=256, waits_for_budget_s=12.0),),
        peers=(replace(peer, conflicting_name="spot"),),
        own_number_used_by="uav",
    )
    found = alarms(fields(wrong, lora="/dev/ttyUSB0: No such file or directory"))
    assert len(found) == 6
    for text, expected in zip(
        found,
        (
            "lora FAILED: /dev/ttyUSB0",
            "xbee: the RADIO REFUSES frames: the channel is busy",
            "REJECTS EVERYTHING",
            "USED ITS AIRTIME",
            "ALSO USED BY uav",
            "spot and husky",
        ),
        strict=True,
    ):
        assert expected in text
    view = thin_view(fields(wrong, lora="/dev/ttyUSB0: No such file or directory"))
    assert [line for line in view if line.startswith("THIN LINK ")] == [f"THIN LINK {text}" for text in found]


def test_the_metrics_have_budgets_counters_and_peers(conditions: ThinConditions) -> None:
    fleet = ThinFleet("base")
    page = render(fleet.nodes["base"].conditions(0.0), {}, {}, thin=conditions, about={}, uptime_s=1.0)
    assert 'udp_mesh_thin_budget_seconds{link="lora"} 360' in page
    assert 'udp_mesh_thin_peer_only{peer="husky"} 1' in page
    assert 'udp_mesh_thin_frames_received_total{link="lora"}' in page
    assert 'udp_mesh_thin_rejecting{link="lora"} 0' in page
