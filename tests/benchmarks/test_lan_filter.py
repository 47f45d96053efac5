"""The table of `benchmarks.lan_filter`."""

from __future__ import annotations

from benchmarks.lan_filter import table


def line(scene: str, load_kbps: int, found: list[float]) -> dict[str, object]:
    return {"scene": scene, "load_kbps": load_kbps, "sent": 4, "round_trips_ms": found}


def test_a_ping_without_an_answer_lowers_the_share_that_was_answered() -> None:
    text = table(
        [
            line("none", 0, [1.0, 2.0, 3.0, 4.0]),
            line("broadcast, filtered", 0, [2.0, 2.0, 9.0]),
            line("broadcast, not filtered", 400, []),
        ]
    )
    assert text.splitlines()[2:] == [
        "| 0 | none | 1 | 100% | 3.0 | 4.0 | 4.0 |",
        "| 0 | broadcast, filtered | 1 | 75% | 2.0 | 9.0 | 9.0 |",
        "| 400 | broadcast, not filtered | 1 | 0% | inf | inf | inf |",
    ]


def test_a_row_is_the_median_of_its_runs() -> None:
    text = table([line("none", 400, [latency_ms] * 4) for latency_ms in (1.0, 5.0, 2.0)])
    assert text.splitlines()[2:] == ["| 400 | none | 3 | 100% | 2.0 | 2.0 | 2.0 |"]
