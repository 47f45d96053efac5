"""Power cycles and reboots of several nodes at once, in every way: all nodes must come back."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat

from meshlab.fleet import VirtualFleet, VirtualNode
from tests.waiting import until

# how a node goes down; it comes back by itself, or is powered on again
_CUT, _KEPT, _TORN, _REBOOT, _REBOOT_AT_ONCE, _OFF_AND_ON = WAYS = (
    "cut", "kept", "torn", "reboot", "reboot at once", "off and on",
)  # fmt: skip


def cycle(fleet: VirtualFleet, names: Sequence[str], count: int, dice: random.Random, *, wait_s: float) -> None:
    """Take nodes down `count` times; fails with the nodes that did not come back within `wait_s`."""
    done = 0
    while done < count:
        down = {name: dice.choice(WAYS) for name in dice.sample(names, dice.randint(1, len(names)))}
        boots = {name: _boots(fleet, name) for name in down}
        with ThreadPoolExecutor(len(down)) as hands:
            list(hands.map(_take_down, [fleet.node(name) for name in down], down.values(), repeat(wait_s)))
        until(_all_back(fleet, boots), f"{down} to boot after {done} others", wait_s=wait_s, look_s=0.05)
        done += len(down)


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


def _take_down(node: VirtualNode, how: str, wait_s: float) -> None:
    if how == _REBOOT:
        node.exec("reboot")
    elif how == _REBOOT_AT_ONCE:
        # the shell goes down with the node, so it has no status
        node.exec("reboot -f")
    elif how == _OFF_AND_ON:
        node.power_cut(back=False)
        node.power_on(wait_s=wait_s)
    else:
        node.power_cut(unsynced={_CUT: "lost"}.get(how, how), wait_s=wait_s)
