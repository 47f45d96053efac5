"""Airtime of batman-adv's own packets, detection of pauses, order of the cases, and the table."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import pytest

from benchmarks import reconvergence_udp_mesh as command
from benchmarks.reconvergence_fleet import OVERHEARD_S, TELEMETRY_S, Bench, Case, NoPauseError, longest_pause
from benchmarks.reconvergence_udp_mesh import Measuring, airtime_us, forget, recorded, share_of_air, table
from meshlab.errors import LabError

# DIFS, half of the first contention window
SPACING_US = 28 + 67.5


def test_airtime_follows_the_802_11_timing_formula() -> None:
    # 12 Mbit/s: 48 bits per symbol of 4 us; 100 bytes, checksum and service bits are 18 symbols
    assert airtime_us(24, 100, "ogm") == SPACING_US + 20 + 18 * 4 + 6
    # 1 Mbit/s, long preamble
    assert airtime_us(2, 100, "ogm") == SPACING_US + 192 + 8 * 104
    # a probe at an 802.11n rate is acknowledged
    assert airtime_us(0, 1500, "probe") == SPACING_US + 36 + 47 * 4 + 6 + 54


def test_the_airtime_share_sums_the_packets_of_all_nodes() -> None:
    overheard = [{"kind": "ogm", "rate": 24, "bytes": 100, "count": 1000}]
    assert share_of_air(overheard) == pytest.approx(1000 * airtime_us(24, 100, "ogm") / (OVERHEARD_S * 1e6))


FIRST, SECOND, THIRD = Case("BATMAN_IV", 500), Case("BATMAN_V", 1000), Case("BATMAN_V", 100)
OVERHEARD = [{"kind": "ogm", "rate": 24, "bytes": 100, "count": 200}]


def result(case: Case, **words: Any) -> dict[str, Any]:
    return {"algorithm": case.algorithm, "interval_ms": case.interval_ms, **words}


def row(results: list[dict[str, Any]], case: Case) -> str:
    return next(line for line in table(results).splitlines() if f"| {case.algorithm} | {case.interval_ms} ms" in line)


def test_a_row_shows_the_number_of_runs_the_median_and_the_range() -> None:
    results = [result(FIRST, pause_s=pause_s, overheard=OVERHEARD) for pause_s in (4.0, 1.0, 2.5)]
    assert row(results, FIRST) == "| BATMAN_IV | 500 ms | 3 | 2.5 s (1.0-4.0) | 10 | 0.19% |"
    assert row(results[:1], FIRST) == "| BATMAN_IV | 500 ms | 1 | 4.0 s | 10 | 0.19% |"


def test_a_row_shows_why_a_case_was_not_measured() -> None:
    results = [result(FIRST, failed="waited 150 s for the mesh to settle")]
    assert row(results, FIRST) == "| BATMAN_IV | 500 ms | 0 | failed: waited 150 s for the mesh to settle | - | - |"
    assert row(results, SECOND) == "| BATMAN_V | 1000 ms | 0 | not measured | - | - |"


def arrivals(*silences: tuple[float, float], until_s: float) -> list[float]:
    """Messages every tenth of a second from 0 on, except between the given times."""
    every = [number * TELEMETRY_S for number in range(int(until_s / TELEMETRY_S) + 1)]
    return [at_s for at_s in every if not any(begin < at_s < end for begin, end in silences)]


def test_a_pause_counts_once_telemetry_has_flowed_again_for_a_while() -> None:
    assert longest_pause(arrivals((5.0, 8.0), until_s=9.0), 5.0, 9.0) is None
    assert longest_pause(arrivals((5.0, 8.0), until_s=13.0), 5.0, 13.0) == pytest.approx(3.0)
    # it has paused again
    assert longest_pause(arrivals((5.0, 8.0), until_s=13.0), 5.0, 16.0) is None


def test_no_pause_is_reported_only_after_a_minimum_time() -> None:
    assert longest_pause(arrivals(until_s=10.0), 5.0, 10.0) is None
    assert longest_pause(arrivals(until_s=40.0), 5.0, 40.0) == 0.0
    assert longest_pause([], 5.0, 40.0) is None


class Machine:
    """A bench whose cases take their outcomes from a list: a pause, or an error."""

    def __init__(self, outcomes: dict[Case, list[float | Exception]]) -> None:
        self.outcomes = outcomes
        self.begun: list[Case] = []
        self.boots = 0
        self.is_gone = False
        self.ends_s = 0.0

    def configure(self, case: Case) -> None:
        self.begun.append(case)

    def settle(self, case: Case) -> None:
        pass

    def overheard(self) -> list[dict[str, Any]]:
        return OVERHEARD

    def pause_s(self) -> float:
        outcome = self.outcomes[self.begun[-1]].pop(0)
        if isinstance(outcome, Exception):
            self.is_gone = isinstance(outcome, LabError)
            raise outcome
        return outcome

    def check_runs(self) -> None:
        if self.is_gone:
            raise LabError("the machine has ended")


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    made = Machine({})

    @contextmanager
    def bench(directory: Path) -> Iterator[Bench]:
        made.boots += 1
        made.is_gone = False
        yield cast(Bench, made)

    monkeypatch.setattr(command, "bench", bench)
    return made


def measure(results: Path, cases: list[Case], *, runs: int = 2, ends_s: float = float("inf")) -> list[str]:
    """Measure, and return the recorded results."""
    Measuring(results, runs, ends_s).all(cases)
    return [f"{one['interval_ms']}: {one.get('pause_s', one.get('failed'))}" for one in recorded(results)]


def test_measured_cases_are_not_measured_again(tmp_path: Path, machine: Machine) -> None:
    results = tmp_path / "results.jsonl"
    machine.outcomes = {FIRST: [1.0, 2.0], SECOND: [3.0, 4.0]}
    assert measure(results, [FIRST]) == ["500: 1.0", "500: 2.0"]
    assert measure(results, [FIRST, SECOND]) == ["500: 1.0", "500: 2.0", "1000: 3.0", "1000: 4.0"]
    assert measure(results, [FIRST, SECOND]) == ["500: 1.0", "500: 2.0", "1000: 3.0", "1000: 4.0"]
    assert machine.begun == [FIRST, SECOND]
    machine.outcomes[FIRST] = [5.0, 6.0]
    forget(results, [FIRST])
    assert measure(results, [FIRST, SECOND]) == ["1000: 3.0", "1000: 4.0", "500: 5.0", "500: 6.0"]


def test_a_failed_case_is_recorded_and_the_next_one_starts(tmp_path: Path, machine: Machine) -> None:
    machine.outcomes = {
        FIRST: [1.0, TimeoutError("waited 90 s for telemetry over the other relay")],
        SECOND: [NoPauseError("telemetry did not pause when one fell silent"), 3.0, 4.0],
        THIRD: [NoPauseError("never")] * 9,
    }
    lines = measure(tmp_path / "results.jsonl", [FIRST, SECOND, THIRD])
    assert lines == [
        "500: 1.0", "500: waited 90 s for telemetry over the other relay", "1000: 3.0", "1000: 4.0", "100: never",
    ]  # fmt: skip
    assert machine.boots == 1


def test_a_dead_machine_is_restarted_once_for_the_remaining_cases(tmp_path: Path, machine: Machine) -> None:
    machine.outcomes = {FIRST: [LabError("gone")], SECOND: [3.0, 4.0], THIRD: [LabError("gone again")]}
    lines = measure(tmp_path / "results.jsonl", [FIRST, SECOND, THIRD])
    assert lines == ["500: gone", "1000: 3.0", "1000: 4.0", "100: gone again"]
    assert machine.boots == 2


def test_cases_not_started_before_the_deadline_are_recorded_as_such(tmp_path: Path, machine: Machine) -> None:
    lines = measure(tmp_path / "results.jsonl", [FIRST, SECOND], ends_s=0.0)
    assert lines == [f"{case.interval_ms}: not begun: no machine, or no time left" for case in (FIRST, SECOND)]
    assert machine.boots == 0
    machine.outcomes = {FIRST: [1.0, 2.0], SECOND: [3.0, 4.0]}
    assert len(measure(tmp_path / "results.jsonl", [FIRST, SECOND])) == 6
