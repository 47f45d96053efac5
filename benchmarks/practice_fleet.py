"""The lab's example fleet on the kernel's 802.11 radios, provisioned and reached over the mesh alone, for benchmarks.

inventory/lab -> QEMU machine with six nodes and three computers -> `meshctl bootstrap` -> `PracticeFleet`
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from meshctl.errors import MeshctlError
from meshctl.inventory import load_fleet
from meshctl.model import Fleet
from meshlab.fleet import QemuFleet
from meshlab.from_inventory import spec_of
from meshlab.inventory_copy import copy_inventory
from meshlab.qemu import control

ROOT = Path(__file__).parents[1]
# under emulation on a busy host; loop avoidance alone holds a new bat0 for half a minute
_START_S, _COMMAND_S, _SETTLE_S = 600.0, 900.0, 240.0
_POLL_S = 0.5
_WINDOW_S = 600
# a connection into a starved machine may break; all commands are safe to repeat
_ATTEMPTS = 3


@contextmanager
def practice_fleet(place: Path, changes: Mapping[str, str] | None = None) -> Iterator[PracticeFleet]:
    """The example fleet, provisioned and unplugged. `changes`: texts of its fleet.yaml, and what replaces each."""
    copy = copy_inventory(ROOT / "inventory" / "lab", place / "lab")
    file = copy.inventory / "fleet.yaml"
    text = file.read_text(encoding="utf-8")
    # confirming a change takes seconds, but minutes in an emulated machine on a starved host
    for old, new in {"confirm_window_s: 90": f"confirm_window_s: {_WINDOW_S}", **(changes or {})}.items():
        if text.count(old) != 1:
            raise ValueError(f"{file}: expected {old!r} once, found it {text.count(old)} times")
        text = text.replace(old, new)
    file.write_text(text, encoding="utf-8")
    inventory = load_fleet(copy.inventory)
    fleet = QemuFleet(spec_of(inventory, links=copy.links), place / "lab").up(wait_s=_START_S)
    try:
        made = PracticeFleet(fleet, inventory, copy.inventory, place / "state")
        made.provision()
        yield made
    finally:
        fleet.down()


class PracticeFleet:
    """The running fleet, seen from the operator's computer."""

    def __init__(self, fleet: QemuFleet, inventory: Fleet, path: Path, state: Path) -> None:
        self.fleet = fleet
        self.inventory = inventory
        self._path = path
        self._state = state
        self.nodes = fleet.spec.names
        robots = inventory.robots.values()
        self.operator = next(robot.name for robot in robots if robot.is_base)
        computers = [robot.computer.address.ip for robot in robots if robot.computer and not robot.is_base]
        self.addresses = [
            str(address) for address in (*(inventory.nodes[name].address.ip for name in self.nodes), *computers)
        ]

    def provision(self) -> None:
        environment = {
            **os.environ,
            "MESHCTL_LAB": str(self.fleet.directory),
            "MESHCTL_INVENTORY": str(self._path),
            "XDG_STATE_HOME": str(self._state),
        }
        left = list(self.nodes)
        for _ in range(_ATTEMPTS):
            words = (sys.executable, "-m", "meshctl", "bootstrap", "--yes", *left)
            done = subprocess.run(
                words, env=environment, check=False, timeout=_COMMAND_S, stdout=subprocess.PIPE, text=True
            )
            # on a starved machine, nodes that were proven too late have rolled back
            left = [
                name for name in left if self.fleet.node(name).address != str(self.inventory.nodes[name].address.ip)
            ]
            if not left:
                break
        else:
            raise RuntimeError(f"cannot provision {', '.join(left)}:\n{done.stdout}")
        for name in self.nodes:
            self.fleet.node(name).plug(False)

    def settle(self) -> None:
        def answers(address: str) -> bool:
            words = f"ip netns exec pc.{self.operator} ping -c 1 -W 2 {address}"
            return control.run(self.fleet.directory, words, timeout_s=60.0).exit_status == 0

        self.until(lambda: all(self.fleet.node(name).is_up() for name in self.nodes), "every node to be up")
        for address in self.addresses:
            self.until(lambda address=address: answers(address), f"{address} to answer")  # type: ignore[misc]

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + _SETTLE_S
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {_SETTLE_S:.0f} s for {what}")
            time.sleep(_POLL_S)

    def on_all(self, command: str, *, but: str = "") -> None:
        names = [name for name in self.nodes if name != but]
        with ThreadPoolExecutor(len(names)) as pool:
            list(pool.map(lambda name: self.on(name, command), names))

    def on(self, name: str, command: str) -> str:
        for left in reversed(range(_ATTEMPTS)):
            try:
                return self.fleet.node(name).exec(command, timeout_s=120.0).check(f"{name}: {command}").stdout
            except MeshctlError as error:
                if not left:
                    raise
                log(f"{name}: {error}; again")
        raise AssertionError("no attempt was made")

    def machine(self, command: str, *, timeout_s: float = 60.0) -> str:
        return control.run(self.fleet.directory, command, timeout_s=timeout_s).check(command[:80]).stdout


def log(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S', time.gmtime())} {text}", file=sys.stderr, flush=True)
