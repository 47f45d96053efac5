"""A replacement by a device as it came out of its box, cut short: the device that took over is known and recorded."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from meshctl.device.trust import parse_pins
from meshctl.inventory import load_fleet
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs")]


def test_a_device_that_took_over_is_recorded_after_ctrl_c_and_by_the_same_command(tmp_path: Path) -> None:
    with Rig(tmp_path, 3) as rig:
        taken = rig.meshctl("bootstrap", "a", "base", "n001", "--yes", "--json")
        assert taken.code == 0, taken.out + taken.err
        inventory = rig.inventory("spare")
        text = rig.inventory("a").read_text(encoding="utf-8")
        good = text + "  n002: {state: spare, label: S2}\n  n003: {state: spare}\n"
        inventory.write_text(good, encoding="utf-8")
        rig.fleet.inject_fault("n001", "off")
        words = ("replace", "spare", "n001", "n002", "--at", "n002", "--yes", "--json")
        assert _at_apply(rig, words, lambda process: process.send_signal(signal.SIGINT)) == 130
        # the change of a node in progress is finished: its outcome decides, not the exit code
        assert rig.fleet.node("n002").address == "10.42.1.1"
        fleet = load_fleet(inventory)
        assert (fleet.nodes["n001"].label, fleet.nodes["n002"].state.value) == ("S2", "retired")
        assert len(_pinned(rig, "n001")) == 1
        # nor has a device that is in no inventory a name of its own
        rig.fleet.inject_fault("n002", "off")
        good = inventory.read_text(encoding="utf-8")
        words = ("replace", "spare", "n001", "bench", "--at", "n003", "--yes", "--json")
        assert _at_apply(rig, words, lambda process: inventory.write_text("nonsense: [", encoding="utf-8")) == 2
        assert len(_pinned(rig, "n001.replacement")) == 1
        inventory.write_text(good, encoding="utf-8")
        repeated = rig.meshctl(*words)
        assert (repeated.code, repeated.results) == (0, {"n001": "unchanged"}), repeated.out + repeated.err
        assert (len(_pinned(rig, "n001")), _pinned(rig, "n001.replacement")) == (1, set())


def _at_apply(rig: Rig, words: tuple[str, ...], strike: Callable[[subprocess.Popen[str]], object]) -> int:
    """Strike once the change is being applied; returns the exit code."""
    with rig.start(*words) as process:
        assert process.stdout is not None
        for line in process.stdout:
            event = json.loads(line)
            if event["event"] == "step" and event["text"] == "apply":
                strike(process)
    return process.returncode


def _pinned(rig: Rig, name: str) -> set[str]:
    pins = [pin for file in rig.directory.glob("known_hosts*") for pin in parse_pins(file.read_text(encoding="utf-8"))]
    return {pin.key.text for pin in pins if pin.covers(name)}
