"""The placement meter on driven links: margins, slopes, bends, and what it advises."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import pytest

from meshctl.placement.margin import (
    UNMEASURED_FADE_DB,
    Sample,
    fade_allowance_db,
    filtered_snr_db,
    path_rate_mbit_s,
    rate_mbit_s,
    required_snr_db,
    slope_db_per_m,
    worse_snr_db,
)
from meshctl.placement.meter import Advice, LinkSnapshot, Meter, PathBeyond, Reading, RelayLink
from meshctl.placement.reading import is_due_to_speak, large, line, page, reading_json, words

NEEDED_DB = 7.0
NOISE_DBM = -95.0


def samples(values: Iterable[float], step_s: float = 1.0, step_m: float = 1.0) -> tuple[Sample, ...]:
    return tuple(Sample(index * step_s, value, index * step_m) for index, value in enumerate(values))


def drive(
    meter: Meter,
    signal_dbm: Callable[[float], float | None],
    to_m: int,
    *,
    from_m: int = 0,
    start_s: float = 0.0,
    heading: Callable[[float], float] = lambda depth_m: 0.0,
    others: Callable[[float], dict[str, float]] = lambda depth_m: {},
    paths: dict[str, PathBeyond] | None = None,
    beacons: int | None = None,
) -> list[Reading]:
    """One reading a second and meter; `signal_dbm` is that of the base at a depth, None: not heard."""
    step = 1 if to_m >= from_m else -1
    found = []
    for index, depth_m in enumerate(range(from_m, to_m + step, step)):
        heard = {"base": signal_dbm(depth_m), **others(depth_m)}
        links = tuple(RelayLink(name, dbm, NOISE_DBM) for name, dbm in heard.items() if dbm is not None)
        found.append(
            meter.step(
                LinkSnapshot(
                    start_s + index,
                    links,
                    paths or {"base": PathBeyond(0), **{name: PathBeyond(0) for name in others(depth_m)}},
                    (float(depth_m), 0.0, 0.0),
                    heading_rad=heading(depth_m),
                    beacons=beacons,
                )
            )
        )
    return found


def test_the_margin_is_the_filtered_signal_less_noise_needed_ratio_and_fading() -> None:
    reading = drive(Meter(NEEDED_DB), lambda depth_m: -70.0, 3)[-1]
    assert reading.snr_db == pytest.approx(25.0)
    assert reading.fade_db == UNMEASURED_FADE_DB
    assert reading.margin_db == pytest.approx(25.0 - NEEDED_DB - UNMEASURED_FADE_DB)
    settled = drive(Meter(NEEDED_DB), lambda depth_m: -70.0 + (4.0 if depth_m % 2 else -4.0), 20)[-1]
    assert settled.fade_db == pytest.approx(1.65 * 4.0, rel=0.02)


def test_the_worse_direction_counts() -> None:
    assert worse_snr_db(-60, -95, -70, -90) == 20
    assert worse_snr_db(-60, -95) == 35
    assert worse_snr_db(-60, None, -80, None) == 15


def test_a_fall_around_a_corner_is_not_filtered_away() -> None:
    level = [30.0] * 10
    assert filtered_snr_db(samples(level)) == pytest.approx(30.0)
    assert filtered_snr_db(samples([*level, 26.0])) > 28.0
    assert filtered_snr_db(samples([*level, 12.0, 10.0])) == 11.0


def test_the_allowance_needs_ten_seconds_of_samples() -> None:
    assert fade_allowance_db(samples([20.0] * 9)) == UNMEASURED_FADE_DB
    assert fade_allowance_db(samples([20.0] * 11)) == 0.0
    # ten seconds, but hardly a sample: nothing is known of their deviation
    assert fade_allowance_db(samples([20.0, 21.0, 20.0], step_s=5.0)) == UNMEASURED_FADE_DB


def test_the_slope_needs_some_meters() -> None:
    assert slope_db_per_m(samples([30 - 0.5 * x for x in range(30)]), 20, 5) == pytest.approx(-0.5)
    assert slope_db_per_m(samples([30.0] * 4), 20, 5) is None
    assert slope_db_per_m(samples([30.0] * 30, step_m=0.0), 20, 5) is None


@pytest.mark.parametrize(
    ("load_mbit_s", "hops", "needed_db"), [(0.1, 1, 4.0), (2.0, 1, 4.0), (2.0, 3, 7.0), (2.0, 9, 7.0), (500.0, 1, 22.0)]
)
def test_the_needed_ratio_is_that_of_the_slowest_modulation_for_the_load(
    load_mbit_s: float, hops: int, needed_db: float
) -> None:
    assert required_snr_db(load_mbit_s, hops) == needed_db


def test_a_path_carries_its_least_rate_over_the_hops_of_one_channel() -> None:
    assert rate_mbit_s(3.9) == 0.0
    assert rate_mbit_s(22.0) == pytest.approx(39.0)
    assert [path_rate_mbit_s(30.0, hops) for hops in (0, 1, 2, 3, 8)] == [30.0, 30.0, 15.0, 10.0, 10.0]


def falling(depth_m: float) -> float:
    """Half a decibel per meter: no margin is left at 46 m."""
    return -65.0 - 0.5 * depth_m


def test_the_advice_turns_from_go_to_drop_soon_to_drop_now() -> None:
    readings = drive(Meter(NEEDED_DB), falling, 50)
    kinds = list(dict.fromkeys(one.advice for one in readings))
    assert kinds[:3] == [Advice.GO, Advice.DROP_SOON, Advice.DROP_NOW]
    soon = next(one for one in readings if one.advice is Advice.DROP_SOON)
    now = next(one for one in readings if one.advice is Advice.DROP_NOW)
    assert soon.meters_left is not None
    assert 10.0 < soon.meters_left < 15.0
    assert now.meters_left is not None
    assert now.meters_left < 5.0
    assert now.slope_db_per_m == pytest.approx(-0.5, abs=0.01)
    # the allowance of a steady slope over ten seconds is 1.65 times 1.58 dB
    assert 37 <= readings.index(now) <= 46


def test_next_to_a_relay_the_steep_slope_gives_no_advice() -> None:
    readings = drive(Meter(NEEDED_DB), lambda depth_m: -30.0 - 20.0 * math.log10(max(depth_m, 1.0)), 30)
    assert {one.advice for one in readings} == {Advice.GO}


def test_another_relay_with_a_good_margin_vetoes_a_drop() -> None:
    readings = drive(Meter(NEEDED_DB), falling, 50, others=lambda depth_m: {"b07": -60.0})
    assert {one.advice for one in readings} == {Advice.GO}
    lonely = Meter(NEEDED_DB)
    steps = [
        lonely.step(
            LinkSnapshot(
                float(depth_m),
                (RelayLink("base", falling(depth_m), NOISE_DBM), RelayLink("b07", -60.0, NOISE_DBM)),
                # b07 does not reach the base
                {"base": PathBeyond(0)},
                (float(depth_m), 0.0, 0.0),
            )
        )
        for depth_m in range(50)
    ]
    assert Advice.DROP_NOW in {one.advice for one in steps}


def test_a_lost_robot_turns_back_to_the_last_place_with_a_margin_and_drops_there() -> None:
    meter = Meter(NEEDED_DB)

    def walled(depth_m: float) -> float | None:
        return -70.0 if depth_m <= 30 else None

    away = drive(meter, walled, 36)
    assert [one.advice for one in away[-3:]] == [Advice.TURN_BACK] * 3
    assert away[-1].reason == "no relay that reaches the base for 6 s"
    assert away[-1].last_good is not None
    assert away[-1].last_good[0] <= 32
    assert away[-1].back_m == pytest.approx(36 - away[-1].last_good[0])
    back = drive(meter, walled, 28, from_m=35, start_s=37.0)
    drop = next(one for one in back if one.advice is Advice.DROP_NOW)
    assert drop.reason == "back at a place with a margin"
    assert drop.margin_db is not None
    assert 28 <= 35 - back.index(drop) <= 30


def test_a_collapse_of_the_margin_turns_back_before_the_link_is_lost() -> None:
    readings = drive(Meter(NEEDED_DB), lambda depth_m: -70.0 if depth_m <= 30 else -92.0, 36)
    assert {one.advice for one in readings[:31]} == {Advice.GO}
    assert Advice.TURN_BACK in {one.advice for one in readings[31:34]}


def test_a_bend_gets_a_beacon_if_the_margin_does_not_carry_around_it() -> None:
    def bend(depth_m: float) -> float:
        return 0.0 if depth_m < 20 else 1.2

    near = drive(Meter(NEEDED_DB), lambda depth_m: -45.0, 25, heading=bend)
    assert {one.advice for one in near} == {Advice.GO}
    far = drive(Meter(NEEDED_DB), lambda depth_m: -75.0, 25, heading=bend)
    assert [index for index, one in enumerate(far) if one.advice is Advice.DROP_NOW] == [20]
    assert far[20].reason == "a bend: bends cost about 20 dB here"


def test_the_meter_learns_what_bends_cost_here() -> None:
    meter = Meter(NEEDED_DB)

    def bends(depth_m: float) -> float:
        return 1.0 * (int(depth_m) // 20)

    # every bend costs 4 dB
    readings = drive(meter, lambda depth_m: -50.0 - 4.0 * (int(depth_m) // 20), 85, heading=bends)
    assert readings[0].turn_loss_db == 20.0
    assert readings[-1].turn_loss_db < 10.0


def test_without_beacons_the_advice_is_to_turn_back() -> None:
    readings = drive(Meter(NEEDED_DB), falling, 48, beacons=0)
    assert readings[-1].advice is Advice.TURN_BACK
    assert readings[-1].reason.endswith("no beacon left")


def test_a_weak_hop_behind_the_relay_is_named() -> None:
    meter = Meter(NEEDED_DB)
    readings = drive(meter, lambda depth_m: -60.0, 15, paths={"base": PathBeyond(2, -3.0, 14.0)})
    assert readings[-1].advice is Advice.GO
    assert readings[-1].reason == "a hop behind base has -3 dB: a beacon is missing there"
    assert (readings[-1].bottleneck_db, readings[-1].hops) == (-3.0, 3)


def test_before_the_first_link_nothing_is_claimed() -> None:
    reading = Meter(NEEDED_DB).step(LinkSnapshot(0.0, (), {}))
    assert reading.advice is Advice.TURN_BACK
    assert reading.reason == "no relay that reaches the base has been heard yet"
    fields = reading_json("spot1", reading)
    assert [fields[key] for key in ("margin_db", "meters_left", "hops", "back_m", "beacons")] == [None] * 5


# For people


def test_the_stock_of_beacons_carries_as_many_spacings() -> None:
    meter = Meter(NEEDED_DB)
    for depth_m in range(30):
        snapshot = LinkSnapshot(
            float(depth_m), (RelayLink("base", falling(depth_m)),), {"base": PathBeyond(0)}, (depth_m, 0.0, 0.0)
        )
        reading = meter.step(
            LinkSnapshot(snapshot.now_s, snapshot.links, snapshot.paths, snapshot.position, beacons=3, spacing_m=40.0)
        )
    assert reading.meters_left is not None
    assert reading.depth_left_m == pytest.approx(reading.meters_left + 120.0)


def test_the_digits_are_large_and_every_figure_is_shown() -> None:
    reading = drive(Meter(NEEDED_DB), falling, 40)[-1]
    lines = page("spot1", reading, 80, "Ctrl-C to quit")
    assert lines[0].startswith(f"spot1   {reading.advice.value}")
    assert max(map(len, lines[2:12])) >= 24
    assert lines[-1] == "Ctrl-C to quit"
    assert line("spot1", reading).startswith(f"spot1 {reading.advice.value}")
    assert large("7", 1) == ["███", "  █", "  █", "  █", "  █"]


def test_a_change_is_spoken_at_once_and_go_seldom() -> None:
    go, drop = Reading(10.0, Advice.GO, "", margin_db=12.7), Reading(11.0, Advice.DROP_NOW, "")
    assert is_due_to_speak(go, None)
    assert not is_due_to_speak(Reading(12.0, Advice.GO, ""), go)
    assert is_due_to_speak(Reading(15.0, Advice.GO, ""), go)
    assert is_due_to_speak(drop, go)
    assert is_due_to_speak(Reading(13.0, Advice.DROP_NOW, ""), drop)
    assert words(go) == "12"
    assert words(drop) == "drop now"
    assert words(Reading(0.0, Advice.TURN_BACK, "", back_m=7.4)) == "turn back, 7 meters"
