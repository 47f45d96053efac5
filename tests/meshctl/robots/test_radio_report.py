"""From the tables of a robot's radios to the report for its daemon."""

from __future__ import annotations

import json
from typing import Any

import pytest

from meshctl.device.link_table import LinkTable, answering_script, is_complete, parse_links
from meshctl.device.observation import Originator
from meshctl.device.parse.sections import split_sections
from meshctl.placement.margin import Sample
from meshctl.robots.radio_report import KEPT_S, MAX_NEIGHBORS, Names, RadioTracker, direction, slope_db_per_s

MACS = {name: f"02:00:00:00:00:{index:02x}" for index, name in enumerate(("base", "b01", "b02", "front", "rear"), 1)}
NAMES = Names({mac: name for name, mac in MACS.items()}, {"base": ("base",), "husky2": ("h2",)})


def row(to: str, via: str, *, tq: int | None = None, kbit_s: int | None = None, best: bool = True) -> Originator:
    return Originator(MACS[to], MACS[via], "mesh0", 300, best, tq, kbit_s)


def table(at_s: float, paths: tuple[Originator, ...] | None = (), **signals: int) -> LinkTable:
    heard = {MACS[name]: dbm for name, dbm in signals.items()}
    return LinkTable(at_s, heard, dict.fromkeys(heard, -95), paths=paths)


def report(*tables: tuple[str, LinkTable], now_s: float | None = None, names: Names = NAMES) -> dict[str, Any]:
    tracker = RadioTracker(load_mbit_s=2.0)
    for radio, one in tables:
        tracker.take(radio, one)
    now_s = max(one.taken_s for _, one in tables) if now_s is None else now_s
    found: dict[str, Any] = json.loads(json.dumps(tracker.report(names, "front", "", now_s)))
    return found


def seconds(count: int, start_dbm: float, change_dbm: float = 0.0) -> list[tuple[str, LinkTable]]:
    """A table a second, all with a path to the base through b01."""
    path = (row("base", "b01", tq=204),)
    return [("front", table(float(s), path, b01=round(start_dbm + change_dbm * s), b02=-80)) for s in range(count)]


def test_a_path_has_the_margin_of_its_next_hop_and_the_quality_of_the_whole() -> None:
    (path,) = report(*seconds(15, -67), now_s=14.5)["paths"]
    assert path == {
        "peer": "base",
        "radio": "front",
        "next_hop": "b01",
        "age_s": 0.5,
        "signal_dbm": -67,
        "noise_dbm": -95,
        # 28 dB, less the 7 dB of MCS 1, which carries 2 Mbit/s over three hops; nothing fades
        "margin_db": 21.0,
        # 60 % of MCS 7
        "bottleneck_bits_per_s": 39_000_000,
        "quality": 0.8,
        "trend": "steady",
        "change_db_per_s": 0.0,
    }


def test_until_ten_seconds_were_measured_fading_is_assumed_and_there_is_no_trend() -> None:
    (path,) = report(*seconds(3, -67))["paths"]
    assert (path["margin_db"], path["trend"], path["change_db_per_s"]) == (11.0, None, None)


@pytest.mark.parametrize(("change", "word"), [(-0.5, "worsening"), (0.5, "improving"), (-0.05, "steady")])
def test_the_trend_is_that_of_the_signal(change: float, word: str) -> None:
    (path,) = report(*seconds(30, -60, change))["paths"]
    assert path["trend"] == word
    assert path["change_db_per_s"] == pytest.approx(change, abs=0.03)


def test_fading_is_no_trend() -> None:
    fades = (0.0, 7.0, -6.0, 3.0, -8.0, 5.0, -2.0)
    samples = tuple(Sample(float(s), 25.0 - 0.05 * s + fades[s % len(fades)], 0.0) for s in range(30))
    assert slope_db_per_s(samples) == 0.0
    steep = tuple(Sample(one.at_s, one.snr_db - one.at_s, 0.0) for one in samples)
    assert slope_db_per_s(steep) == pytest.approx(-1.05, abs=0.2)


def test_the_rates_of_the_driver_and_the_routing_protocol_bound_the_bottleneck() -> None:
    slow = (row("base", "b01", kbit_s=3200),)
    fast = (row("base", "b01", kbit_s=90_000),)
    heard = table(0.0, b01=-60)

    def bottleneck(paths: tuple[Originator, ...], expected_mbit_s: float | None) -> int:
        expected = {} if expected_mbit_s is None else {MACS["b01"]: expected_mbit_s}
        one = LinkTable(0.0, heard.signals_dbm, heard.noise_dbm, "", expected, paths)
        (path,) = report(("front", one))["paths"]
        assert path["quality"] is None
        return int(path["bottleneck_bits_per_s"])

    assert bottleneck(slow, None) == 3_200_000
    assert bottleneck(slow, 1.5) == 1_500_000
    assert bottleneck(fast, 26.0) == 26_000_000


def test_of_two_radios_the_better_path_counts_and_that_across_the_switch_does_not() -> None:
    # rear is reached by front's own switch; its next hop is not heard over the air
    front = table(0.0, (row("base", "rear", tq=255),), b02=-75)
    rear = table(0.0, (row("base", "b01", tq=180), row("base", "b02", tq=250, best=False)), b01=-66)
    (path,) = report(("front", front), ("rear", rear))["paths"]
    assert (path["radio"], path["next_hop"], path["quality"]) == ("rear", "b01", 0.706)
    better = table(1.0, (row("base", "b02", tq=220),), b02=-75)
    (path,) = report(("front", front), ("rear", rear), ("front", better))["paths"]
    assert (path["radio"], path["next_hop"]) == ("front", "b02")


def test_without_a_routing_table_only_neighbors_have_a_path() -> None:
    found = report(("front", table(0.0, None, b01=-60, base=-70)))
    assert [(path["next_hop"], path["quality"]) for path in found["paths"]] == [("base", None)]
    assert [one["name"] for one in found["neighbors"]] == ["b01", "base"]
    assert report(("front", table(0.0, None, b01=-60)))["paths"] == []


def test_an_unknown_next_hop_is_shown_by_its_mac_and_an_unknown_destination_has_no_path() -> None:
    heard = table(0.0, (row("base", "b01", tq=255),), b01=-60)
    partly = Names({MACS["base"]: "base"}, NAMES.robots)
    assert report(("front", heard), names=partly)["paths"][0]["next_hop"] == MACS["b01"]
    found = report(("front", heard), names=Names({}, NAMES.robots))
    assert found["paths"] == []
    assert found["neighbors"][0]["name"] == MACS["b01"]


def test_an_old_table_is_forgotten_and_a_silent_radio_leaves_the_other() -> None:
    both = (("front", table(0.0, (row("base", "b01", tq=255),), b01=-60)), ("rear", table(20.0, None, b02=-60)))
    assert [path["age_s"] for path in report(*both)["paths"]] == [20.0]
    found = report(*both, now_s=KEPT_S + 0.1)
    assert found["paths"] == []
    assert [(one["radio"], one["age_s"]) for one in found["neighbors"]] == [("rear", 10.1)]


def test_a_radio_in_a_crowd_reports_its_strongest_neighbors() -> None:
    macs = {f"06:00:00:00:01:{number:02x}": -30 - number % 60 for number in range(200)}
    crowd = LinkTable(0.0, macs, dict.fromkeys(macs, None), paths=())
    neighbors = report(("front", crowd))["neighbors"]
    assert len(neighbors) == MAX_NEIGHBORS
    assert neighbors[0]["signal_dbm"] == -30
    # a radio that reports no noise has thermal noise
    assert neighbors[0]["margin_db"] == 65.0 - 7.0 - 10.0


def test_words_of_a_change() -> None:
    assert [direction(change) for change in (-1.0, -0.1, -0.09, 0.0, 0.2)] == [
        "worsening",
        "worsening",
        "steady",
        "steady",
        "improving",
    ]


def test_an_answer_is_complete_with_its_last_section() -> None:
    nonce = "meshctl-1"
    answer = f"{nonce} begin iw.stations mesh0\n\n{nonce} end 1\n{nonce} begin done\n\n{nonce} end 0\n".encode()
    assert is_complete(answer, nonce)
    assert not any(is_complete(answer[:length], nonce) for length in range(len(answer)))
    assert not is_complete(answer, "meshctl-2")
    empty = parse_links(split_sections(answer, nonce), (), taken_s=1.0)
    assert empty == LinkTable(1.0, {}, {})


def test_the_script_for_many_requests_fits_a_command_of_dropbear() -> None:
    text = answering_script()
    # MAX_CMD_LEN of 2019.78
    assert len(text.encode()) < 9000
    assert "read -r N" in text
