"""The table of shared logs counts only runs of one length."""

from __future__ import annotations

from benchmarks.shared_logs import table


def _run(way: str, seed: int, seconds: float, arrived: int, delay_s: float | None) -> dict[str, object]:
    counts = {"published": 50, "arrived": arrived, "twice": 0, "delay_p50_s": delay_s, "airtime_s": 100.0}
    return {"way": way, "seed": seed, "seconds": seconds, **counts}


def test_runs_of_another_length_or_of_later_seeds_do_not_count() -> None:
    runs = [
        _run("log", 1, 450.0, 25, 10.0),
        _run("log", 2, 450.0, 0, None),
        _run("log", 3, 450.0, 50, 99.0),
        _run("log", 1, 900.0, 50, 99.0),
        _run("flooding", 1, 450.0, 0, None),
    ]
    assert table(runs, ["log", "flooding"], 450.0, 2)[2:] == [
        "| log | 2 | 25.0% of 100 | 0 | 10 | 2000 |",
        "| flooding | 1 | 0.0% of 50 | - | - | 2000 |",
    ]
