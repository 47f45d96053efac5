"""What radios measure of their channel and links reaches the status, and what they do not report stays unknown."""

from __future__ import annotations

from dataclasses import replace

import pytest

from meshctl.device.observation import ChannelSurvey, Observation, Sensors
from meshctl.model import Fleet
from meshctl.status.json_output import as_json
from meshctl.status.radio_facts import radios_of
from meshctl.status.rows import row
from meshctl.status.values import FleetStatus, NodeStatus
from tests.meshctl.status.fleets import HEALTHY, alarms, seen, status_of


def node_of(status: FleetStatus, name: str) -> NodeStatus:
    return next(node for node in status.nodes if node.name == name)


def surveyed(active_ms: int, busy_ms: int, frequency_mhz: int = 2437) -> Observation:
    return seen("b01", {}, surveys=(ChannelSurvey("mesh0", frequency_mhz, -95, active_ms, busy_ms),))


def with_signal(observation: Observation, signal_dbm: int) -> Observation:
    stations = tuple(replace(one, signal_dbm=signal_dbm) for one in observation.stations or ())
    return replace(observation, stations=stations)


def test_the_snr_is_known_in_both_directions(fleet: Fleet) -> None:
    status = status_of(fleet, {**HEALTHY, "rover": with_signal(HEALTHY["rover"], -70)})
    (b01,) = node_of(status, "rover").neighbors
    assert (b01.snr_db, b01.snr_there_db, b01.worse_snr_db, b01.mesh) == (25, 35, 25, "main")
    cells = row(node_of(status, "rover"))
    assert [cells[key].text for key in ("snr", "mcs", "busy", "waits")] == ["25/35 dB", "15/12", "30%", "2"]
    (link,) = (one for node in as_json(status)["nodes"] if node["name"] == "rover" for one in node["neighbours"])
    assert (link["tx_mcs"], link["rx_mcs"], link["noise_dbm"], link["snr_there_db"]) == ("MCS 15", "MCS 12", -95, 35)


def test_what_a_radio_does_not_report_is_unknown_and_no_alarm(fleet: Fleet) -> None:
    silent = {name: replace(one, surveys=None, sensors=None) for name, one in HEALTHY.items()}
    status = status_of(fleet, silent)
    rover = node_of(status, "rover")
    assert rover.neighbors[0].worse_snr_db is None
    assert [row(rover).get(key) for key in ("snr",)] == [None]
    assert row(rover)["busy"].text == row(rover)["waits"].text == ""
    (radio,) = next(node for node in as_json(status)["nodes"] if node["name"] == "rover")["radios"]
    assert {key for key, value in radio.items() if value is not None} == {"ifname", "mesh", "channel"}
    assert not {"snr", "busy", "radio-queue"} & set(alarms(status, "rover"))


def test_a_weak_signal_of_either_direction_to_the_next_hop_is_a_warning(fleet: Fleet) -> None:
    deaf = {**HEALTHY, "b01": with_signal(HEALTHY["b01"], -86)}
    status = status_of(fleet, deaf)
    assert alarms(status, "rover")["snr"].text == "the signal between it and b01 is 9 dB above the noise"
    assert "snr" in alarms(status, "b01"), "its next hop is the base, which it hears as weakly"
    assert "snr" not in alarms(status_of(fleet, {**HEALTHY, "b01": with_signal(HEALTHY["b01"], -85)}), "rover")


def test_a_busy_channel_and_a_long_queue_are_warnings(fleet: Fleet) -> None:
    busy = replace(
        HEALTHY["rover"],
        surveys=(ChannelSurvey("mesh0", 2437, -95, 100_000, 81_000),),
        sensors=Sensors({"phy0": 101}, {}),
    )
    found = alarms(status_of(fleet, {**HEALTHY, "rover": busy}), "rover")
    assert found["busy"].text == "channel 6 is busy for 81% of the time at mesh0"
    assert found["radio-queue"].text == "101 packets are queued at mesh0"


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        (None, surveyed(100_000, 30_000), (0.3, 100.0)),
        (surveyed(100_000, 30_000), surveyed(105_000, 34_000), (0.8, 5.0)),
        # restarted since, another channel, or asked again at once
        (surveyed(100_000, 30_000), surveyed(2_000, 500), (0.25, 2.0)),
        (surveyed(90_000, 30_000, 2412), surveyed(100_000, 30_000), (0.3, 100.0)),
        (surveyed(100_000, 30_000), surveyed(100_100, 30_100), (30_100 / 100_100, 100.1)),
        (None, surveyed(50, 50), (None, None)),
    ],
)
def test_the_busy_time_is_that_since_the_last_observation(
    fleet: Fleet, before: Observation | None, now: Observation, expected: tuple[float | None, float | None]
) -> None:
    (radio,) = radios_of(fleet.nodes["b01"], now, before)
    assert (radio.busy_ratio, radio.busy_over_s) == pytest.approx(expected)
