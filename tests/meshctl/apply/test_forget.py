"""Laws of who is asked to forget a radio, and when; and that they do, over real SSH, on a virtual fleet."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.apply.forget import (
    EXPECTED_S,
    FIRST_PAUSE_S,
    LONGEST_PAUSE_S,
    MOST_ASKED,
    Entry,
    Forgetting,
    behind,
    by_holder,
    entries_of,
    forget_script,
    next_ask_s,
    watch_script,
)
from meshctl.apply.job import Job
from meshctl.device.observation import Observation, Originator, Station, WirelessLink
from tests.meshctl.plan.support import fleet, running
from tests.meshctl.proof.rig import Rig

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


def test_a_node_that_is_silent_for_long_is_told_of_once_however_often_its_neighbours_are_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    steps: list[str] = []
    notes: list[str] = []
    scripts: list[str] = []

    @contextmanager
    def step(name: str) -> Iterator[None]:
        steps.append(name)
        yield

    def answer(script: str, *, timeout_s: float) -> SimpleNamespace:
        scripts.append(script)
        return SimpleNamespace(stdout=f"{MAC}\n")

    connection = SimpleNamespace(run=answer, close=lambda: None)
    work = SimpleNamespace(
        around={"b02": itself(MAC), "b01": knows("b01", ("mesh0", MAC))},
        interrupt=SimpleNamespace(leaving=False),
        access=SimpleNamespace(take=lambda name: connection, keep=lambda name, kept: None),
        note=lambda text, node: notes.append(text),
    )
    forgetting = Forgetting(cast("Job", SimpleNamespace(name="b02", work=work, step=step)))
    monkeypatch.setattr("meshctl.apply.forget.next_ask_s", lambda asked_s: float("-inf"))
    forgetting.begins()
    for _ in range(5):
        forgetting.while_silent()
    forgetting.when_back(went_back=False)
    assert len(scripts) == 6
    assert steps == ["neighbours forget it"]
    assert notes == ["b01 forgot its radio, to hear it anew"]


def hop(name: str, mac: str, next_hop: str, *, best: bool = True) -> Observation:
    return replace(running(fleet(), name), originators=(Originator(mac, next_hop, "mesh0", 100, best, 200),))


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
    "iw": """now=$(cat "$HERE/now"); case $4 in
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
    assert printed == (f"{MAC}\n" if is_deleted else "")
    assert deleted == ([f"1 mesh0 {MAC}", "1 mesh0 unknown"] if is_deleted else [])


def test_no_word_of_a_node_is_run(tmp_path: Path) -> None:
    evil = [Entry("b01", "mesh0; touch x", "$(touch x)"), Entry("b01", "'; touch x; '", "`touch x`")]
    deletions(tmp_path, [5000] * 4, forget_script(evil, older_than_s=1) + watch_script("b02", evil, for_s=2))
    assert len((tmp_path / "deleted").read_text().splitlines()) >= 4
    assert not (tmp_path / "x").exists()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Rig(tmp_path, count=2, window_s=60) as made:
        made.take_in(made.current)
        yield made


@pytest.mark.lab
@pytest.mark.xdist_group("lab")
@pytest.mark.timeout(600)
def test_after_a_change_of_a_radio_its_neighbour_has_forgotten_it(
    rig: Rig,
) -> None:
    _, new = rig.flip()
    ended = rig.meshctl("provision", new, "n001", "--yes", "--json")
    assert ended.results == {"n001": "done"}, ended.out + ended.err
    # told only by those that had an entry and removed it
    notes = [event["text"] for event in ended.events if event["event"] == "note" and event["node"] == "n001"]
    assert notes == ["base forgot its radio, to hear it anew"]
