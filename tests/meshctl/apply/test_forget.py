"""Laws of who is asked to forget a radio, with which words, and when."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.apply.forget import (
    EXPECTED_S,
    FIRST_PAUSE_S,
    LONGEST_PAUSE_S,
    MOST_ASKED,
    Entry,
    behind,
    booted_unforgotten_s,
    by_holder,
    entries_of,
    forget_script,
    neighbours_now,
    next_ask_s,
    silent_holders,
    watch_script,
)
from meshctl.device.observation import Observation, Originator, Station, WirelessLink
from meshctl.plan.radios import NO_RADIOS, Radios
from tests.meshctl.plan.support import fleet, running

MAC = "02:00:00:00:01:02"
OTHER = "02:00:00:00:01:03"
BASE = "02:00:00:00:01:00"


def knows(name: str, *stations: tuple[str, str]) -> Observation:
    return replace(running(fleet(), name), stations=tuple(Station(ifname, mac) for ifname, mac in stations))


def itself(*macs: str) -> Observation:
    links = tuple(WirelessLink(f"mesh{number}", "IBSS", mac) for number, mac in enumerate(macs))
    return replace(running(fleet(), "b02"), links=links, mesh=None, macs={})


def test_those_whose_radios_know_the_node_are_asked_on_the_interface_and_by_the_mac_they_told() -> None:
    around = {
        "b01": knows("b01", ("mesh0", OTHER), ("mesh1", MAC.upper())),
        "b02": itself(MAC),
        "b03": knows("b03", ("mesh0", OTHER)),
        "base": knows("base", ("wlan0", MAC)),
    }
    assert entries_of("b02", around) == (Entry("b01", "mesh1", MAC.upper()), Entry("base", "wlan0", MAC))


def test_every_radio_of_the_node_is_forgotten() -> None:
    around = {"b01": knows("b01", ("mesh0", MAC), ("mesh0", OTHER)), "b02": itself(MAC, OTHER)}
    assert by_holder(entries_of("b02", around)) == {"b01": (Entry("b01", "mesh0", MAC), Entry("b01", "mesh0", OTHER))}


def test_of_a_node_that_told_nothing_and_of_one_without_a_radio_in_a_mesh_nobody_is_asked() -> None:
    around = {"b01": knows("b01", ("mesh0", MAC))}
    assert entries_of("b02", around) == ()
    assert entries_of("b02", {**around, "b02": itself()}) == ()


def test_a_station_table_of_any_length_has_few_asked() -> None:
    entries = [Entry(f"n{number:03}", "mesh0", MAC) for number in range(200)]
    assert list(by_holder(entries)) == [f"n{number:03}" for number in range(MOST_ASKED)]


@given(st.lists(st.floats(0, 30), max_size=20))
def test_a_silent_node_has_its_neighbours_asked_at_once_and_then_ever_more_seldom_until_once_a_minute(
    lateness: list[float],
) -> None:
    asked: list[float] = []
    for late_s in lateness:
        due_s = next_ask_s(asked)
        asked.append(due_s + late_s if asked else late_s)
    pauses = [next_ask_s(asked[: count + 1]) - asked[count] for count in range(len(asked))]
    assert next_ask_s([]) < 0
    assert pauses == pytest.approx(sorted(pauses))
    assert all(FIRST_PAUSE_S - 1e-6 <= pause <= LONGEST_PAUSE_S + 1e-6 for pause in pauses)


def test_of_two_radios_only_those_who_know_the_one_that_starts_anew_are_asked() -> None:
    around = {"b01": knows("b01", ("mesh0", MAC), ("mesh1", OTHER)), "b02": itself(MAC, OTHER)}
    assert entries_of("b02", around, Radios(frozenset({"mesh1"}))) == (Entry("b01", "mesh1", OTHER),)
    assert entries_of("b02", around, NO_RADIOS) == ()


def hears(*macs: str) -> Observation:
    return replace(itself(MAC), neighbours=(), stations=tuple(Station("mesh0", mac) for mac in macs))


def test_whom_the_node_hears_and_who_told_nothing_may_know_it() -> None:
    around = {
        "b01": replace(knows("b01"), macs={}, links=(WirelessLink("mesh0", "IBSS", BASE),)),
        "b02": hears(BASE, OTHER),
    }
    names = {OTHER: "b03", MAC: "b02"}
    assert silent_holders("b02", around, names, ("b01", "b02", "b03", "b04")) == ("b03",)
    assert neighbours_now(around["b02"], {**names, BASE: "b01"}) == ("b01", "b03")


def test_who_answered_without_telling_of_its_stations_may_know_the_node() -> None:
    around = {"b01": replace(knows("b01"), stations=None), "b02": hears(OTHER)}
    assert silent_holders("b02", around, {OTHER: "b01"}, ()) == ("b01",)


def test_a_stranger_may_be_any_fellow_whose_radios_nobody_has_seen() -> None:
    around = {"b01": knows("b01"), "b02": hears("02:99:00:00:00:01")}
    assert silent_holders("b02", around, {OTHER: "b03"}, ("b01", "b02", "b03", "b04")) == ("b04",)
    assert silent_holders("b02", around, {"02:99:00:00:00:01": "b02"}, ("b04",)) == ()


def hop(name: str, mac: str, next_hop: str, *, best: bool = True) -> Observation:
    return replace(running(fleet(), name), originators=(Originator(mac, next_hop, "mesh0", 100, best, 200),))


def at(seen: Observation, asked_at_s: float, *, uptime_s: float | None) -> Observation:
    return replace(seen, asked_at_s=asked_at_s, answered_at_s=asked_at_s + 1.0, uptime_s=uptime_s)


@pytest.mark.parametrize(
    ("connected_s", "is_old"), [(150, True), (104, True), (102, False), (40, False), (None, False)]
)
def test_who_has_known_a_radio_from_before_its_node_booted_must_forget_it(
    connected_s: int | None, is_old: bool
) -> None:
    # it is up since 900, give or take what an answer takes; the neighbour knows it since 1001 - connected_s
    around = {
        "b01": at(
            replace(knows("b01"), stations=(Station("mesh0", MAC, connected_s=connected_s),)), 1000, uptime_s=9e9
        ),
        "b02": at(itself(MAC), 1000.0, uptime_s=100.0),
    }
    assert booted_unforgotten_s("b02", around) == (900.0 if is_old else None)
    assert booted_unforgotten_s("b01", around) is None
    assert booted_unforgotten_s("b02", {**around, "b02": at(itself(MAC), 1000.0, uptime_s=None)}) is None
    assert booted_unforgotten_s("b03", around) is None


def test_those_whose_best_way_to_the_base_begins_with_the_node_are_behind_it() -> None:
    around = {
        "b01": hop("b01", BASE, BASE),
        "b02": itself(MAC),
        "b03": hop("b03", BASE.upper(), MAC),
        "b04": hop("b04", BASE, MAC, best=False),
        "b05": hop("b05", OTHER, MAC),
    }
    assert behind("b02", around, (BASE,)) == {"b03"}
    assert behind("b02", around, ()) == frozenset()


# iw of a holder: `get` tells the age that stands in line N of `ages` at second N, `del` writes down when it was called;
# the clock is what sleeps
FAKES = {
    "iw": """now=$(cat "$HERE/now")
[ $# != 1 ] || printf 'phy#0\\n\\tInterface mesh0\\nphy#1\\n\\tInterface mesh1\\n'
case $4 in
get) sed -n "${now}s/.*/Station $5\\n\\tinactive time:\\t& ms\\n\\tconnected time:\\t& seconds/p" "$HERE/ages" ;;
del) echo "$now $2 $5" >>"$HERE/deleted"; [ "$5" != unknown ] ;;
esac""",
    "sleep": 'now=$(cat "$HERE/now"); echo $((now + $1)) >"$HERE/now"',
    "start-stop-daemon": 'while [ "$1" != -- ]; do shift; done; shift; exec sh "$@"',
    "mkdir": ":",
}


def deletions(place: Path, ages: list[int], text: str) -> tuple[str, list[str]]:
    """What a script prints on a holder whose entry has these ages, second by second, and what it deletes when."""
    for name, body in FAKES.items():
        (place / name).write_text(f"#!/bin/sh\n{body}\n", encoding="ascii")
        (place / name).chmod(0o755)
    (place / "now").write_text("1")
    (place / "ages").write_text("".join(f"{age}\n" for age in ages))
    environ = {"PATH": f"{place}:/usr/bin:/bin", "HERE": str(place)}
    done = subprocess.run(
        ("sh", "-c", text), env=environ, cwd=place, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.stderr == ""
    log = place / "deleted"
    return done.stdout, log.read_text().splitlines() if log.exists() else []


def watched(place: Path, ages: list[int]) -> list[int]:
    """When an entry with these ages is deleted by who watches it."""
    _, deleted = deletions(place, [0, *ages], watch_script("b02", [Entry("b01", "mesh0", MAC)], for_s=len(ages)))
    assert all(line.endswith(f" mesh0 {MAC}") for line in deleted)
    return [int(line.split()[0]) - 1 for line in deleted]


def test_who_watches_forgets_a_radio_in_the_short_silence_in_which_it_starts_anew_and_not_again(tmp_path: Path) -> None:
    ages = [100] * 4 + [1200] + [50] * 60
    assert watched(tmp_path, ages) == [5]


def test_a_radio_that_was_too_quick_to_be_missed_is_forgotten_once_when_it_must_have_started(tmp_path: Path) -> None:
    assert watched(tmp_path, [100] * 65) == [EXPECTED_S]


def test_later_only_a_long_silence_counts(tmp_path: Path) -> None:
    ages = [100] * 4 + [1200] + [50] * 30 + [2900] + [50] * 10 + [3100] + [50] * 5
    assert watched(tmp_path, ages) == [5, 47]


@pytest.mark.parametrize(("age_s", "is_deleted"), [(11, False), (12, True)])
def test_only_an_entry_from_before_is_forgotten_when_asked_and_printed(
    tmp_path: Path, age_s: int, is_deleted: bool
) -> None:
    text = forget_script([Entry("b01", "mesh0", MAC), Entry("b01", "mesh0", "unknown")], older_than_s=11.2)
    printed, deleted = deletions(tmp_path, [age_s], text)
    # one that is not there cannot be removed
    assert printed == (f"gone {MAC}\nkept unknown\n" if is_deleted else "")
    assert deleted == ([f"1 mesh0 {MAC}", "1 mesh0 unknown"] if is_deleted else [])


def test_who_did_not_tell_looks_on_all_of_its_interfaces(tmp_path: Path) -> None:
    printed, deleted = deletions(tmp_path, [50], forget_script([Entry("b01", "", MAC)], older_than_s=11.2))
    assert printed == f"gone {MAC}\n" * 2
    assert deleted == [f"1 mesh0 {MAC}", f"1 mesh1 {MAC}"]


def test_no_word_of_a_node_is_run(tmp_path: Path) -> None:
    evil = [Entry("b01", "mesh0; touch x", "$(touch x)"), Entry("b01", "'; touch x; '", "`touch x`")]
    deletions(tmp_path, [5000] * 4, forget_script(evil, older_than_s=1) + watch_script("b02", evil, for_s=2))
    assert len((tmp_path / "deleted").read_text().splitlines()) >= 4
    assert not (tmp_path / "x").exists()
