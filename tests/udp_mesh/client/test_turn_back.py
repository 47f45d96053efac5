"""The example that says when to turn back: its decision, and the program beside a real daemon."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.udp_mesh.daemon.processes import poll, two_daemons
from udp_mesh.client.turn_back import Need, decide, rate, time_left_s

GUIDE = Path(__file__).parents[3] / "docs" / "how-to" / "turn-back.md"
NEED = Need(bits_per_s=300e3, priority=9, reserve_s=60.0)
STEADY = {"direction": "steady", "measure": "capacity", "change_per_s": -0.001}


def worsening(change_per_s: float, measure: str = "capacity") -> dict[str, Any]:
    return {"direction": "worsening", "measure": measure, "change_per_s": change_per_s}


def peer(bits_per_s: float | None = 5e6, **changes: object) -> dict[str, Any]:
    """Urgent priorities would get 1 Mbit/s more."""
    available = None if bits_per_s is None else [bits_per_s + 1e6] * 9 + [bits_per_s] * 7
    good = {"online": True, "unanswered_for_s": None, "loss": 0.0, "trend": STEADY, "available_bits_per_s": available}
    return {**good, **changes}


@pytest.mark.parametrize(
    ("found", "reason"),
    [
        (None, "offline"),
        (peer(online=False), "offline"),
        (peer(unanswered_for_s=2.4), "no answer for 2 s"),
        (peer(299e3), "299 kbit/s of 300 kbit/s"),
        # ln(600 / 300) / 0.02 = 35 s
        (peer(600e3, trend=worsening(-0.02)), "worsening, 300 kbit/s for 35 s more"),
        (peer(loss=0.12), "12 % of the packets are lost"),
    ],
)
def test_the_robot_turns_back(found: dict[str, Any] | None, reason: str) -> None:
    assert decide(found, NEED, before=False) == (True, reason)
    assert decide(found, NEED, before=True) == (True, reason)


@pytest.mark.parametrize(
    "found",
    [
        peer(301e3),
        peer(unanswered_for_s=1.0),
        peer(loss=0.09),
        peer(600e3, trend=None),
        # there is more time than the reserve; and of a round trip nothing can be calculated
        peer(6e6, trend=worsening(-0.02)),
        peer(600e3, trend=worsening(-0.02, "round-trip")),
    ],
)
def test_the_robot_continues(found: dict[str, Any]) -> None:
    assert not decide(found, NEED, before=False).turn_back


@pytest.mark.parametrize(
    ("found", "turn_back"),
    [
        (peer(610e3), False),
        (peer(590e3), True),
        (peer(loss=0.04), False),
        (peer(loss=0.06), True),
        (peer(6e6, trend=worsening(-0.02)), True),
    ],
)
def test_on_its_way_back_the_robot_continues_only_once_the_link_is_good(found: dict[str, Any], turn_back: bool) -> None:
    assert not decide(found, NEED, before=False).turn_back
    assert decide(found, NEED, before=True).turn_back == turn_back


@pytest.mark.parametrize("before", [False, True])
def test_what_is_not_measured_changes_nothing(before: bool) -> None:
    assert decide(peer(None), NEED, before) == (before, "not measured yet")


def test_the_time_left_is_that_of_an_exponential_decline() -> None:
    assert time_left_s(1000.0, 500.0, worsening(-0.1)) == pytest.approx(math.log(2) / 0.1)
    assert time_left_s(1000.0, 500.0, None) == time_left_s(1000.0, 500.0, STEADY) == math.inf


def test_rates_are_shown_with_their_unit() -> None:
    assert (rate(12_140_000), rate(299_400)) == ("12.1 Mbit/s", "299 kbit/s")


def test_the_program_of_the_guide_says_go_and_then_to_turn_back_when_the_peer_is_gone() -> None:
    words, _ = re.findall(r"^ *\$ python3 (-m udp_mesh\.client\.turn_back .*)$", GUIDE.read_text(), re.MULTILINE)
    command = [sys.executable, *words.replace(" base ", " bob ").split()]
    with two_daemons() as (alice, bob):
        program = subprocess.Popen(
            [*command, "--socket", str(alice.socket)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        lines: list[str] = []
        reader = threading.Thread(target=lambda: lines.extend(iter(program.stdout.readline, "")))  # type: ignore[union-attr]
        reader.start()
        try:
            poll(lambda: lines or None, "the program says go")
            bob.kill()
            poll(lambda: lines[1:] or None, "the program says to turn back")
            alice.kill()
            assert program.wait(30) == 1
            assert program.stderr is not None
            assert program.stderr.read().startswith("turn_back: ")
        finally:
            program.kill()
            reader.join()
            program.communicate()
    assert [line.split(":")[0] for line in lines] == ["go", "turn-back"]


MARGIN_NEED = NEED._replace(margin_db=5.0)


def radio(margin_db: float | None, change_db_per_s: float = 0.0) -> dict[str, Any]:
    direction = "worsening" if change_db_per_s else "steady"
    trend = {"direction": direction, "change_db_per_s": change_db_per_s}
    return {"margin_db": margin_db, "next_hop": "b02", "trend": trend}


@pytest.mark.parametrize(
    ("found", "before", "decision"),
    [
        (radio(4.0), False, (True, "4 dB of margin to b02")),
        # (15 - 5) / 0.25 = 40 s
        (radio(15.0, -0.25), False, (True, "15 dB of margin to b02, for 40 s more")),
        # far above the need the trend says nothing
        (radio(30.0, -1.0), False, (False, "5.0 Mbit/s")),
        (radio(6.0), False, (False, "5.0 Mbit/s")),
        (radio(6.0), True, (True, "not good enough yet: 6 dB of margin to b02")),
        (radio(11.0), True, (False, "5.0 Mbit/s")),
        # not known
        (radio(None), False, (False, "5.0 Mbit/s")),
        (None, False, (False, "5.0 Mbit/s")),
    ],
)
def test_the_radio_margin_counts_if_it_is_needed(
    found: dict[str, Any] | None, before: bool, decision: tuple[bool, str]
) -> None:
    assert decide(peer(radio=found), MARGIN_NEED, before) == decision
    assert not decide(peer(radio=found), NEED, before).turn_back


def test_a_silent_robot_turns_back_and_continues_by_its_margin_alone() -> None:
    assert decide(peer(None, radio=radio(4.0)), MARGIN_NEED, before=False).turn_back
    assert decide(peer(None, radio=radio(12.0)), MARGIN_NEED, before=True) == (False, "12 dB of margin to b02")
    # without a collector it knows nothing, and changes nothing
    assert decide(peer(None), MARGIN_NEED, before=True) == (True, "not measured yet")
