"""`meshctl deployed --watch`: mark beacons as deployed that two snapshots in a row show to be dropped, until Ctrl-C.

A single snapshot can be wrong: while a robot turns, its own radios may hear a beacon in its rack as weakly as a dropped
one. The inventory is loaded again whenever one of its files has changed, and never written over a change of another.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import NoReturn

from meshctl.cli.fleet_view import FleetView, collect
from meshctl.cli.inventory_versions import versions
from meshctl.cli.output import echo
from meshctl.errors import InputError
from meshctl.model import Fleet, Node
from meshctl.status import assess
from meshctl.status.dropped import dropped_beacons


@dataclass(slots=True)
class TwoSnapshots:
    """Beacons that the last snapshot showed to be dropped, with the reasons. Pure."""

    suspects: Mapping[str, str] = field(default_factory=dict)

    def confirmed(self, dropped: Mapping[str, str]) -> dict[str, str]:
        """Those of `dropped` that the last snapshot had, too; the others wait for the next one."""
        both = {name: reason for name, reason in dropped.items() if name in self.suspects}
        self.suspects = {name: reason for name, reason in dropped.items() if name not in both}
        return both


def dropped_in(view: FleetView, chosen: Iterable[Node]) -> dict[str, str]:
    """The dropped ones of these beacons in one snapshot of the mesh, each with the reason."""
    names = {node.name for node in chosen}
    snapshot = collect(view)
    status = assess(snapshot, view.nodes, time.time())
    return {name: why for name, why in dropped_beacons(view.fleet, status.nodes).items() if name in names}


def watch_for_drops(
    open_view: Callable[[], AbstractContextManager[FleetView]],
    choose: Callable[[Fleet], list[Node]],
    mark: Callable[[list[Node]], None],
    period_s: float,
) -> NoReturn:
    """Query the mesh every `period_s` seconds and `mark` the confirmed beacons; ends with KeyboardInterrupt.

    Raises what `open_view` and `choose` raise at the start; later they are reported, and tried again.
    """
    snapshots = TwoSnapshots()
    is_first = True
    while True:
        try:
            with open_view() as view:
                chosen = choose(view.fleet)
                is_first = False
                _watch_one_version(view, chosen, snapshots, mark, period_s)
        except InputError as error:
            if is_first:
                raise
            # an edit that is not finished: nothing is marked until the inventory loads again
            echo(f"not marked: {error}", err=True)
            time.sleep(period_s)


def _watch_one_version(
    view: FleetView,
    chosen: list[Node],
    snapshots: TwoSnapshots,
    mark: Callable[[list[Node]], None],
    period_s: float,
) -> None:
    """Until a file of the inventory changes, also by `mark`."""
    before = versions(view.fleet)
    while versions(view.fleet) == before:
        began_s = time.monotonic()
        dropped = dropped_in(view, chosen)
        known = snapshots.suspects
        confirmed = snapshots.confirmed(dropped)
        for name, why in snapshots.suspects.items():
            echo(f"{name}: {why}; marked if the next snapshot agrees", err=True)
        for name in sorted(known.keys() - dropped.keys()):
            echo(f"{name}: not confirmed", err=True)
        for name, why in confirmed.items():
            echo(f"{name}: {why}", err=True)
        if confirmed:
            mark([node for node in chosen if node.name in confirmed])
        time.sleep(max(0.0, period_s - (time.monotonic() - began_s)))
