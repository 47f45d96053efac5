"""Power cycles and reboots of several nodes at once, in every way and at any moment: all nodes must come back."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat

from meshlab.fleet import VirtualFleet
from tests.waiting import until

# how a node goes down; it comes back by itself, or is powered on again
_CUT, _OFF_AND_ON, _KEPT, _TORN, _REBOOT, _REBOOT_AT_ONCE = _LAST = (
    "cut", "off and on", "kept", "torn", "reboot", "reboot at once",
)  # fmt: skip
# the first cut, and others of the boots that follow, before one of the above
_WHILE_IT_BOOTS = "cut again while it boots"
WAYS = (*_LAST, _WHILE_IT_BOOTS)
# what becomes of data that is not synced
_UNSYNCED = {_CUT: "lost", _KEPT: "kept", _TORN: "torn"}
_MOST_AGAIN = 12


@dataclass(frozen=True, slots=True)
class Fall:
    """How a node goes down in a round: at which moment, and before that in which boots, in lengths of a boot."""

    how: str
    after: float
    boots: tuple[float, ...] = ()

    @property
    def cycles(self) -> Counter[str]:
        return Counter({self.how: 1, _WHILE_IT_BOOTS: len(self.boots)})

    @property
    def length(self) -> float:
        return self.after + sum(self.boots)


@dataclass(frozen=True, slots=True)
class Round:
    """Nodes that went down and came back together, and how long that took."""

    down: Mapping[str, Fall]
    took_s: float

    @property
    def cycles(self) -> Counter[str]:
        """How often nodes lost their power or restarted, by the way."""
        found: Counter[str] = Counter()
        for fall in self.down.values():
            found.update(fall.cycles)
        return found


def cycle(
    fleet: VirtualFleet,
    names: Sequence[str],
    count: int,
    dice: random.Random,
    *,
    wait_s: float,
    met: Callable[[Sequence[str]], None] = lambda names: None,
) -> Iterator[Round]:
    """Take several nodes down at once, until `count` power cycles are done. `met` waits for their mesh to meet nodes.

    Fails with the nodes that did not come back within `wait_s`.
    """
    boot_s, done = 1.0, 0
    while done < count:
        down = {name: _fall(dice) for name in dice.sample(names, dice.randint(1, len(names)))}
        boots = {name: _boots(fleet, name) for name in down}
        began = time.monotonic()
        with ThreadPoolExecutor(len(down)) as hands:
            list(hands.map(_take_down, repeat(fleet), down, down.values(), repeat(boot_s), repeat(wait_s)))
        until(_all_back(fleet, boots), f"{down} to boot after {done} power cycles", wait_s=wait_s, look_s=0.05)
        # the longest of its nodes' boots is about what is left of a round without its moments
        boot_s = (time.monotonic() - began) / (1.0 + max(fall.length for fall in down.values()))
        met(list(down))
        one = Round(down, time.monotonic() - began)
        done += one.cycles.total()
        yield one


def _fall(dice: random.Random) -> Fall:
    how = dice.choice((_CUT, _OFF_AND_ON, *_LAST))
    # the others run a command on the node, which has to be up
    again = dice.randint(0, _MOST_AGAIN) if how in (_CUT, _OFF_AND_ON) else 0
    # half of them in the first 2 % of a boot, while the node's namespaces and devices are set up
    return Fall(how, dice.random(), tuple(dice.random() ** 6 for _ in range(again)))


def _all_back(fleet: VirtualFleet, boots: Mapping[str, int]) -> Callable[[], bool]:
    left = set(boots)

    def back() -> bool:
        left.difference_update(
            [name for name in left if _boots(fleet, name) > boots[name] and fleet.node(name).is_up()]
        )
        return not left

    return back


def _boots(fleet: VirtualFleet, name: str) -> int:
    return int(fleet.request("node", node=name)["boots"])


def _take_down(fleet: VirtualFleet, name: str, fall: Fall, boot_s: float, wait_s: float) -> None:
    node = fleet.node(name)
    time.sleep(fall.after * boot_s)
    for length in fall.boots:
        fleet.request("power_cut", node=name, unsynced="lost", back=True)
        time.sleep(length * boot_s)
    if fall.how == _REBOOT:
        node.exec("reboot")
    elif fall.how == _REBOOT_AT_ONCE:
        # the shell goes down with the node, so it has no status
        node.exec("reboot -f")
    elif fall.how == _OFF_AND_ON:
        node.power_cut(back=False)
        time.sleep(fall.after * boot_s)
        node.power_on(wait_s=wait_s)
    else:
        node.power_cut(unsynced=_UNSYNCED[fall.how], wait_s=wait_s)
