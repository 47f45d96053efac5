"""The table of `benchmarks.lan_filter`."""

from __future__ import annotations

from benchmarks.lan_filter import table


def test_a_ping_without_an_answer_lowers_the_share_that_was_answered() -> None:
    def line(scene: str, found: list[float]) -> dict[str, object]:
        return {"scene": scene, "sent": 4, "round_trips_ms": found}

    text = table(
        [
            line("unicast on the robot", [1.0, 2.0, 3.0, 4.0]),
            line("broadcast, filtered", [2.0, 2.0, 9.0]),
            line("broadcast, not filtered", []),
        ]
    )
    assert text.splitlines()[2:] == [
        "| unicast on the robot | 1 | 100% | 3.0 | 4.0 |",
        "| broadcast, filtered | 1 | 75% | 2.0 | 9.0 |",
        "| broadcast, not filtered | 1 | 0% | inf | inf |",
    ]
