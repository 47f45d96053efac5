"""`provision --together`: all nodes change simultaneously, and none keeps the change unless a quorum is healthy.

Only the case of a power cut runs in every `make test`; the others are proofs.
"""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable
from typing import Any

import pytest

from tests.meshctl.proof.rig import COMMAND_LIMIT_S, Ended, Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("fleet")]

Event = dict[str, Any]


def provision(rig: Rig, variant: str, on_event: Callable[[Event, subprocess.Popen[str]], None] | None = None) -> Ended:
    """`provision --together`; `on_event` sees each event when it is printed."""
    lines = []
    with rig.start("provision", variant, "--yes", "--json", "--together") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        for line in process.stdout:
            lines.append(line)
            if on_event is not None:
                on_event(json.loads(line), process)
        err = process.stderr.read()
        process.wait(timeout=COMMAND_LIMIT_S)
    return Ended(process.returncode, "".join(lines), err)


def states(rig: Rig, old: str, new: str) -> dict[str, str]:
    return {name: rig.state_of(name, old, new) for name in ("base", *rig.names)}


def of_all(rig: Rig, value: str, **others: str) -> dict[str, str]:
    return {name: others.get(name, value) for name in ("base", *rig.names)}


def test_a_node_that_loses_power_rolls_back_alone_and_a_resume_changes_it(rig: Rig) -> None:
    old, new = rig.flip()
    rig.fleet.inject_fault("n001", "power-cut@reload_config")
    ended = provision(rig, new)
    rig.fleet.repair("n001")
    assert (ended.code, ended.results) == (1, of_all(rig, "done", n001="rolled back")), ended.out + ended.err
    notes = [event["text"] for event in ended.events if event["event"] == "note"]
    assert "5 nodes change simultaneously; 3 must pass their checks" in notes
    (lost,) = (each for each in ended.events[-1]["outcomes"] if each["node"] == "n001")
    assert "its power was cut" in lost["reason"]
    assert states(rig, old, new) == of_all(rig, "new", n001="old")
    resumed = rig.meshctl("resume", new, "--yes", "--json")
    assert (resumed.code, resumed.results) == (0, {"n001": "done"}), resumed.out + resumed.err
    assert states(rig, old, new) == of_all(rig, "new")


@pytest.mark.proof
def test_all_nodes_roll_back_with_the_base_and_a_resume_changes_them_together(rig: Rig) -> None:
    old, new = rig.flip()
    rig.fleet.inject_fault("base", "power-cut@reload_config")
    ended = provision(rig, new)
    rig.fleet.repair("base")
    assert (ended.code, ended.results) == (1, of_all(rig, "rolled back")), ended.out + ended.err
    assert states(rig, old, new) == of_all(rig, "old")
    resumed = rig.meshctl("resume", new, "--yes", "--json")
    assert (resumed.code, resumed.results) == (0, of_all(rig, "done")), resumed.out + resumed.err
    assert any("simultaneously" in event.get("text", "") for event in resumed.events)
    assert states(rig, old, new) == of_all(rig, "new")


@pytest.mark.proof
def test_a_node_that_fails_its_check_rolls_back_alone(rig: Rig) -> None:
    old, new = rig.flip()

    def cut(event: Event, process: subprocess.Popen[str]) -> None:
        if "simultaneously" in event.get("text", ""):
            rig.fleet.inject_fault("base-n002", "link-down")

    ended = provision(rig, new, cut)
    assert ended.results == of_all(rig, "done", n002="rolled back"), ended.out + ended.err
    (failed,) = (each for each in ended.events[-1]["outcomes"] if each["node"] == "n002")
    assert "neighbor" in failed["reason"]
    assert states(rig, old, new) == of_all(rig, "new", n002="old")


@pytest.mark.proof
def test_too_many_failed_checks_roll_all_nodes_back(rig: Rig) -> None:
    old, new = rig.flip()

    def cut(event: Event, process: subprocess.Popen[str]) -> None:
        if "simultaneously" in event.get("text", ""):
            for name in rig.names[:3]:
                rig.fleet.inject_fault(f"base-{name}", "link-down")

    ended = provision(rig, new, cut)
    assert ended.results == of_all(rig, "rolled back"), ended.out + ended.err
    # the base, which hears one of four neighbors, fails as well
    assert ended.events[-1]["outcomes"][0]["reason"].startswith(
        "all nodes were rolled back: the base did not pass its checks"
    )
    assert states(rig, old, new) == of_all(rig, "old")
    rig.current = old


@pytest.mark.proof
def test_an_interrupt_before_the_moment_cancels_the_change_on_all_nodes(rig: Rig) -> None:
    old, new = rig.flip()

    def interrupt(event: Event, process: subprocess.Popen[str]) -> None:
        if (event["event"], event.get("node"), event.get("text")) == ("step", "n001", "stage"):
            process.send_signal(signal.SIGINT)

    ended = provision(rig, new, interrupt)
    assert (ended.code, ended.results) == (130, of_all(rig, "pending")), ended.out + ended.err
    assert states(rig, old, new) == of_all(rig, "old")
    resumed = rig.meshctl("resume", new, "--yes", "--json")
    assert (resumed.code, resumed.results) == (0, of_all(rig, "done")), resumed.out + resumed.err


@pytest.mark.proof
def test_a_full_flash_cancels_the_change_and_names_the_node(rig: Rig) -> None:
    old, new = rig.flip()
    rig.fleet.inject_fault("n003", "full-flash")
    ended = provision(rig, new)
    rig.fleet.repair("n003")
    assert ended.results == of_all(rig, "pending", n003="failed"), ended.out + ended.err
    others = {each["reason"] for each in ended.events[-1]["outcomes"] if each["node"] != "n003"}
    assert all(
        reason.startswith("the simultaneous change was canceled: n003 could not be armed") for reason in others
    ), others
    assert states(rig, old, new) == of_all(rig, "old")
    rig.current = old
