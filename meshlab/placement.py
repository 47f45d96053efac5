"""The radio environment of a running fleet, kept as `ground.json` in its directory; a lock serializes changes.

`current_environment` reads it, `set_environment` replaces it, `move` changes one node's position. `set_power` and
`flush_stations` do the rest of what a scenario does to a fleet. Works for every fleet that `VirtualFleet.attach` finds.
"""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

from meshctl.placement.path_loss import Point
from meshlab import propagation_file
from meshlab.errors import LabError
from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.state import Power

_LOCK_NAME = "ground.lock"
# some 250 bytes each, so that a request stays below 128 KiB (`node_runner.MESSAGE_BYTES`)
_LINKS_PER_REQUEST = 300
_PARALLEL_FLUSHES = 8


def current_environment(fleet: VirtualFleet) -> RadioEnvironment:
    """The fleet's radio environment; until one is set, the links it was started with."""
    path = fleet.directory / propagation_file.FLEET_FILE
    return propagation_file.load(path) if path.exists() else RadioEnvironment(links=fleet.spec.links)


def set_environment(fleet: VirtualFleet, environment: RadioEnvironment) -> None:
    """Replace the fleet's links by those of `environment`, except links that were set one by one.

    Nodes outside the fleet are ignored; nodes without a position or a link hear no one.
    """
    with _locked(fleet):
        _apply(fleet, environment)


def move(fleet: VirtualFleet, name: str, to: Point) -> None:
    """Move a node. Raises InputError for a node without a position."""
    fleet.spec.node(name)
    with _locked(fleet):
        _apply(fleet, current_environment(fleet).with_moved(name, to))


def set_power(fleet: VirtualFleet, name: str, on: bool) -> None:
    """Switch a node off, with everything synced, or on, without waiting for its boot."""
    if on:
        fleet.request("power_on", node=name)
    elif fleet.node(name).power is not Power.OFF:
        fleet.request("power_cut", node=name, unsynced="kept", back=False)


def flush_stations(fleet: VirtualFleet, name: str) -> None:
    """Delete the stations of `name` on every other node that is up, as the kernel does by itself within a minute."""
    stations = "; ".join(
        f'iw dev "$dev" station del {radio.mac} 2>/dev/null' for radio in fleet.spec.node(name).radios if radio.mac
    )
    script = f"for dev in $(iw dev | sed -n 's/^[[:space:]]*Interface //p'); do {stations or ':'}; done; true"

    def flush(node: VirtualNode) -> None:
        # a node that is going off or not up yet has no stations
        with contextlib.suppress(LabError):
            if node.name != name and node.is_up():
                node.exec(script)

    with ThreadPoolExecutor(_PARALLEL_FLUSHES) as pool:
        list(pool.map(flush, fleet.nodes))


def _apply(fleet: VirtualFleet, environment: RadioEnvironment) -> None:
    names = set(fleet.spec.names)
    links = [asdict(link) for link in links_of(environment) if link.ends <= names]
    parts = [links[first : first + _LINKS_PER_REQUEST] for first in range(0, len(links), _LINKS_PER_REQUEST)] or [[]]
    for number, part in enumerate(parts, 1):
        fleet.request("links", part=part, is_last=number == len(parts))
    path = fleet.directory / propagation_file.FLEET_FILE
    new = path.with_name(f"{propagation_file.FLEET_FILE}.new")
    new.write_text(propagation_file.dump(environment), encoding="utf-8")
    new.replace(path)


@contextlib.contextmanager
def _locked(fleet: VirtualFleet) -> Iterator[None]:
    """Hold the lock on the fleet's radio environment."""
    with (fleet.directory / _LOCK_NAME).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
