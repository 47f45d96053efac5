"""Random faults and killed operators while spares replace dead nodes: one device has each name, and runs it wholly."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from meshctl.device.trust import parse_pins
from meshctl.inventory import load_fleet
from meshctl.model import NodeState
from tests.meshctl.proof.chaos import (
    FAULTS,
    MEANING,
    Strike,
    at_rest,
    leftovers,
    run_until,
    strike_during,
)
from tests.meshctl.proof.rig import Ended, Rig

TRIES, SEEDS = 3, (40, 41)
# of each dead node its spare
REPLACED = {"n001": "n003", "n002": "n004"}
OTHERS = ("base", "n003", "n004")


@dataclass(frozen=True, slots=True)
class Attempt:
    """`kill_after`: which of its events the operator is killed after; None: never."""

    strikes: tuple[Strike, ...]
    kill_after: int | None


def attempts_of(seed: int, names: Sequence[str], count: int) -> tuple[Attempt, ...]:
    """The schedule of a seed."""
    chance = random.Random(seed)
    return tuple(
        Attempt(
            tuple(
                Strike(chance.uniform(0.0, 15.0), name, chance.choice(FAULTS))
                for name in chance.sample(list(names), chance.randint(0, 2))
            ),
            chance.choice((None, *(chance.randint(1, 9) for _ in range(3)))),
        )
        for _ in range(count)
    )


def test_a_schedule_follows_from_its_seed() -> None:
    assert attempts_of(1, OTHERS, 20) == attempts_of(1, OTHERS, 20) != attempts_of(2, OTHERS, 20)
    everything = attempts_of(1, OTHERS, 200)
    assert {strike.node for one in everything for strike in one.strikes} == set(OTHERS)
    assert {None, 1, 9} <= {one.kill_after for one in everything}


@pytest.mark.proof
@pytest.mark.lab
@pytest.mark.xdist_group("rigs")
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", SEEDS)
def test_whatever_cuts_a_replacement_short_the_same_command_completes_it(seed: int, tmp_path: Path) -> None:
    with Rig(tmp_path / "rig", 4) as rig:
        assert rig.take_in("a").code == 0
        inventory = rig.inventory("spares")
        spares = "".join(f"  {name}: {{state: spare}}\n" for name in REPLACED.values())
        inventory.write_text(rig.inventory("a").read_text(encoding="utf-8") + spares, encoding="utf-8")
        keys = pinned(rig)
        off: list[str] = []
        for turn, (old, spare) in enumerate(REPLACED.items()):
            rig.fleet.inject_fault(old, "off")
            off.append(old)
            for number, attempt in enumerate(attempts_of(seed + 100 * turn, OTHERS, TRIES)):
                if load_fleet(inventory).nodes[spare].state is NodeState.RETIRED:
                    break
                _try(rig, f"seed {seed}, {old}, attempt {number}: {attempt}", old, spare, attempt, off, keys)
            if load_fleet(inventory).nodes[spare].state is not NodeState.RETIRED:
                completed = rig.meshctl("replace", "spares", old, spare, "--yes", "--json")
                assert completed.code == 0, completed.out + completed.err
            assert identity(rig, spare, old) == old
            assert pinned(rig)[old] == keys[spare]
            assert spare not in pinned(rig)
        # all nodes change, which removes what killed runs have uploaded
        text = inventory.read_text(encoding="utf-8")
        inventory.write_text(text.replace("log_size_kib: 64", "log_size_kib: 128"), encoding="utf-8")
        ended = rig.meshctl("provision", "spares", "--yes", "--json")
        assert set(ended.results.values()) <= {"done", "unchanged"}, ended.out + ended.err
        assert leftovers(rig, OTHERS) == {}


def _try(
    rig: Rig, label: str, old: str, spare: str, attempt: Attempt, off: Sequence[str], keys: dict[str, set[str]]
) -> None:
    found: list[Ended | None] = []

    def operate() -> None:
        process = rig.start("replace", "spares", old, spare, "--yes", "--json")
        found.append(run_until(attempt.kill_after, process))

    strike_during(rig, attempt.strikes, [operate], off)
    states = at_rest(rig, OTHERS)
    assert set(states.values()) <= {"idle", "staged"}, f"{label}: {states}"
    runs = identity(rig, spare, old)
    assert runs in (old, spare), f"{label}: {spare} runs {runs}"
    is_recorded = load_fleet(rig.inventory("spares")).nodes[spare].state is NodeState.RETIRED
    (ended,) = found
    # the inventory never promises more than the device keeps
    assert not is_recorded or runs == old, f"{label}: recorded, but {spare} runs {runs}"
    if ended is None:
        # the old device might be switched on again
        assert runs == old or keys[old] <= pinned(rig)[old], f"{label}: {pinned(rig)}"
        return
    assert "Traceback" not in ended.err, f"{label}: {ended.err}"
    allowed = MEANING[ended.results.get(old, "pending")]
    assert ("new" if runs == old else "old") in allowed, f"{label}: {spare} runs {runs}, {ended.out} {ended.err}"
    assert is_recorded == (ended.code == 0), f"{label}: {ended.out} {ended.err}"
    if ended.code != 0:
        assert keys[old] <= pinned(rig)[old], f"{label}: {pinned(rig)}"


def identity(rig: Rig, device: str, old: str) -> str:
    """Which node of inventory `a` a device wholly is, `device` or `old`, at the address of that node only."""
    for name in (device, old):
        if rig.has_files_of(device, "a", name):
            address = load_fleet(rig.inventory("a")).nodes[name].address.ip
            return name if rig.fleet.node(device).address == str(address) else f"{name} at another address"
    return "a mixture"


def pinned(rig: Rig) -> dict[str, set[str]]:
    """Node -> its pinned host keys."""
    found: dict[str, set[str]] = {}
    for file in rig.directory.glob("known_hosts*"):
        for pin in parse_pins(file.read_text(encoding="utf-8")):
            for name in pin.names:
                found.setdefault(name, set()).add(pin.key.text)
    return found
