"""One QEMU machine for the tests of this folder, provisioned from factory state to a working mesh once; the tests of
`team` and `routed` have their own, each a group and thus a worker of its own.

Tests that change the fleet leave it in the state of its inventory. scripts/setup-lab installs QEMU when it is missing:
no test is skipped.
"""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import pytest

from meshctl.topology import with_alternates
from meshlab.fleet import QemuFleet, VirtualNode
from meshlab.from_inventory import spec_of
from meshlab.inventory_copy import copy_inventory
from meshlab.qemu import control
from meshlab.spec import FleetSpec
from tests import waiting
from tests.conftest import TRIED_AGAIN
from tests.meshlab.fleet_report import report

INVENTORY = Path(__file__).with_name("inventory")
SETUP = Path(__file__).parents[3] / "scripts" / "setup-lab"
# packages are downloaded, then an emulated machine boots on a busy host; at worst twice
START_S = 900.0
# a run of meshctl over several hops with emulated logins, up to the end of a confirm window of ten minutes
COMMAND_S = 900.0
TRIES = 3
# six emulated nodes that boot together took up to 200 s on two cores beside twenty other programs
WAIT_S = 600.0
# An emulated machine is busy most of the time, and takes a quarter of a processor when idle: with three times the share
# of another process its tests, and the whole run, end sooner
MACHINE_NICE = -5
NODES = ("base", "b01", "b02", "husky-front", "husky-rear")


@dataclass(frozen=True, slots=True)
class Done:
    """One finished run of meshctl."""

    status: int
    text: str
    errors: str

    @property
    def json(self) -> Any:
        return json.loads(self.text)

    @property
    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.text.splitlines() if line.startswith("{")]


@dataclass(frozen=True, slots=True)
class Lab:
    """The running fleet, and the copy of the inventory that belongs to it. `NODES`: those of its mesh, base first."""

    NODES: ClassVar[tuple[str, ...]] = NODES
    # of a robot whose path to the base station is the mesh's longest
    FAR_COMPUTER: ClassVar[str] = "10.42.0.10"

    fleet: QemuFleet
    inventory: Path
    state: Path

    def meshctl(
        self, *words: str, expect: int | None = 0, on_line: tuple[str, Callable[[], None]] | None = None
    ) -> Done:
        """Run meshctl in a separate process, as an operator does; `expect` None: any exit code.

        `on_line`: a text, and the function to call as soon as meshctl prints it.
        """
        environment = {
            **os.environ,
            "MESHCTL_LAB": str(self.fleet.directory),
            "MESHCTL_INVENTORY": str(self.inventory),
            "XDG_STATE_HOME": str(self.state),
            "COLUMNS": "200",
        }
        lines: list[str] = []
        with (
            tempfile.TemporaryFile("w+") as complaints,
            subprocess.Popen(
                (sys.executable, "-m", "meshctl", *words),
                env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints, text=True,
            ) as process,
        ):  # fmt: skip
            patience = threading.Timer(COMMAND_S, process.kill)
            patience.start()
            try:
                assert process.stdout is not None
                for line in process.stdout:
                    lines.append(line)
                    if on_line is not None and on_line[0] in line:
                        on_line[1]()
                        on_line = None
                status = process.wait()
            finally:
                patience.cancel()
                process.kill()
            complaints.seek(0)
            done = Done(status, "".join(lines), complaints.read())
        assert expect is None or status == expect, f"meshctl {' '.join(words)}: {done.text}{done.errors}"
        return done

    def bootstrap(self) -> None:
        """Bootstrap the mesh's nodes on the bench and unplug them, so that they are reached only over the mesh.

        On a starved host a node may not answer in time, or not begin; then an operator does it again.
        """
        left = set(self.NODES)
        for _ in range(TRIES):
            done = self.meshctl("bootstrap", "--yes", "--json", *sorted(left), expect=None)
            finished = [event for event in done.events if event["event"] == "finished"]
            left -= {event["node"] for event in finished if event["outcome"]["result"] in ("done", "unchanged")}
            if not left:
                break
        else:
            raise AssertionError(f"meshctl bootstrap did not take in {sorted(left)} in {TRIES} tries: {done.errors}")
        for name in self.NODES[1:]:
            self.node(name).plug(False)
        self.settle()

    def provision(self, *nodes: str) -> list[list[dict[str, Any]]]:
        """Provision until all nodes match the inventory; returns the events of each run.

        On a starved host a connection may be given up, and the change is undone: then an operator does it again.
        """
        runs = []
        for _ in range(TRIES):
            done = self.meshctl("provision", "--yes", "--json", *nodes, expect=None)
            runs.append(done.events)
            if done.status == 0:
                return runs
            self.settle()
        raise AssertionError(f"meshctl provision did not succeed {TRIES} times: {runs[-1]}")

    def edit(self, old: str, new: str) -> None:
        """Replace a text that occurs once in the inventory."""
        file = self.inventory / "fleet.yaml"
        text = file.read_text(encoding="utf-8")
        assert text.count(old) == 1, f"{old!r} stands {text.count(old)} times in {file}"
        file.write_text(text.replace(old, new), encoding="utf-8")

    @contextmanager
    def edited(self, *pairs: tuple[str, str]) -> Iterator[None]:
        """Replace texts of the inventory, each of which occurs once, for the time of the block."""
        for old, new in pairs:
            self.edit(old, new)
        try:
            yield
        finally:
            for old, new in reversed(pairs):
                self.edit(new, old)

    def node(self, name: str) -> VirtualNode:
        return self.fleet.node(name)

    def on(self, node: str, command: str) -> str:
        """The output of a command on a node's console."""
        return self.node(node).exec(command).check(f"{node}: {command}").stdout

    def computer(self, robot: str, command: str) -> str:
        """The output of a command on a robot's computer."""
        done = control.run(self.fleet.directory, f"ip netns exec pc.{robot} {command}", timeout_s=120.0)
        return done.check(f"{robot}'s computer: {command}").stdout

    def answers(self, robot: str, address: str) -> bool:
        """Whether a ping from a robot's computer is answered."""
        words = f"ip netns exec pc.{robot} ping -c 1 -W 2 {address}"
        return control.run(self.fleet.directory, words).exit_status == 0

    def originators(self, node: str) -> dict[str, str]:
        """The routes of the node's batman-adv: each destination -> its next hop."""
        names = self.names()
        known = json.loads(self.on(node, "batctl meshif bat0 originators_json"))
        return {names[one["orig_address"]]: names[one["neigh_address"]] for one in known if one.get("best")}

    def fresh_originators(self, node: str) -> set[str]:
        """The nodes of which the node's batman-adv has had news within the last seconds, over any path."""
        names = self.names()
        known = json.loads(self.on(node, "batctl meshif bat0 originators_json"))
        return {names[one["orig_address"]] for one in known if one["last_seen_msecs"] < 5000}

    def neighbors(self, node: str) -> set[str]:
        """The neighbors that the node's batman-adv has heard within the last seconds."""
        names = self.names()
        known = json.loads(self.on(node, "batctl meshif bat0 neighbors_json"))
        return {names[one["neigh_address"]] for one in known if one["last_seen_msecs"] < 5000}

    def hops(self) -> dict[str, int]:
        """The number of hops from the base to each node, along the kernels' current routes."""
        others = self.NODES[1:]
        next_hops = {name: self.originators(name).get("base", "") for name in others}
        found = {"base": 0}
        for name in others:
            at, count = name, 0
            while at != "base" and count <= len(others):
                at, count = next_hops.get(at, "base"), count + 1
            found[name] = count
        return found

    def names(self) -> dict[str, str]:
        """The MAC addresses of each node's radio, the board's and its alternates -> its name."""
        return with_alternates({radio.mac: node.name for node in self.fleet.spec.nodes for radio in node.radios})

    def settle(self) -> None:
        """Wait until every node is up and the base's batman-adv has a route to every other one."""
        others = set(self.NODES[1:])
        until(lambda: all(self.node(name).is_up() for name in self.NODES), "every node to boot")
        until(lambda: self.originators("base").keys() >= others, "routes from the base to every node")
        try:
            until(lambda: self.answers("base-station", self.FAR_COMPUTER), "the Husky's computer to answer")
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.tables()}") from error

    def meet(self, names: Sequence[str]) -> None:
        """Wait until the base hears each of these nodes through its mesh, and each of them the base."""
        others = [name for name in (self.NODES if "base" in names else names) if name != "base"]
        pairs = [*(("base", name) for name in others), *((name, "base") for name in others if name in names)]
        until(lambda: all(target in self.fresh_originators(at) for at, target in pairs), f"the mesh to meet {names}")

    def tables(self) -> str:
        """The kernel tables of each node, for the report of a mesh that does not forward."""
        names = self.names()
        parts = []
        for name in self.NODES:
            text = self.node(name).exec(_TABLES).stdout
            for mac, owner in names.items():
                text = text.replace(mac, owner)
            parts.append(f"--- {name}\n{text}")
        parts.append("--- switches and computers\n" + control.run(self.fleet.directory, _LANS).stdout)
        return "\n".join(parts)


L = TypeVar("L", bound=Lab)

_TABLES = """
batctl meshif bat0 originators -H
batctl meshif bat0 transglobal -H
batctl meshif bat0 gwl -H 2>/dev/null
batctl meshif bat0 claimtable -H 2>/dev/null
batctl meshif bat0 backbonetable -H 2>/dev/null
for dev in $(iw dev | sed -n 's/^.*Interface //p'); do
    iw dev $dev station dump | grep -E 'Station|time:|bytes|packets|failed'
done
ip neigh
bridge fdb show br br-lan 2>/dev/null | grep -v permanent
uptime
"""


_LANS = """
bridge fdb show | grep -v permanent
for space in $(ip netns list | cut -d ' ' -f 1); do
    echo "$space"
    ip -n "$space" neigh
    ip -n "$space" -s link show dev eth0
done
"""


def until(condition: Callable[[], bool], what: str) -> None:
    """`waiting.until` with a timeout and interval for emulated machines."""
    waiting.until(condition, what, wait_s=WAIT_S, look_s=0.2)


@contextmanager
def field_lab(kind: type[L], inventory: Path, place: Path, *, before: Callable[[L], None] | None = None) -> Iterator[L]:
    """Factory-fresh nodes, bootstrapped on the bench and unplugged, so that they are reached only over the mesh.

    A mesh that does not form is set up once more in a new machine, and the reason reported at the end.
    """
    set_up_host()
    for turn in ("lab", "again"):
        copy = copy_inventory(inventory, place / turn)
        fleet = QemuFleet(_quick(spec_of(copy.fleet, links=copy.links)), place / turn)
        try:
            with niceness_of_children(MACHINE_NICE):
                fleet.up(wait_s=START_S)
            made = kind(fleet, copy.inventory, place / f"state-{turn}")
            if before is not None:
                before(made)
            try:
                made.bootstrap()
            except AssertionError as error:
                # here, because the fleet has stopped when the fixture fails
                error.add_note(report(fleet, str(error)))
                if turn == "again":
                    raise
                _tried_again.append("\n".join((str(error), *error.__notes__)))
                continue
            yield made
            return
        finally:
            fleet.down()


@contextmanager
def niceness_of_children(nice: int) -> Iterator[None]:
    """The processes that this thread starts in the block get this niceness, where that is permitted."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, nice)
        yield
    finally:
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, before)


def _quick(spec: FleetSpec) -> FleetSpec:
    """With one kind of host key: an RSA key takes an emulated node three to five seconds of CPU time."""
    return replace(spec, nodes=tuple(replace(node, host_key_types=("ed25519",)) for node in spec.nodes))


# why a machine was set up once more, until a test's report can include it
_tried_again: list[str] = []


@pytest.fixture(autouse=True)
def why_once_more(record_property: Callable[[str, object], None]) -> None:
    while _tried_again:
        record_property(TRIED_AGAIN, _tried_again.pop())


@pytest.fixture(scope="package")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """Five nodes of one mesh, three hops long."""
    with field_lab(Lab, INVENTORY, tmp_path_factory.mktemp("real")) as made:
        yield made


def set_up_host() -> None:
    """Install QEMU and the requirements of apt, unless they are installed; two workers cannot do that at once."""
    with Path(tempfile.gettempdir(), "meshctl-setup-lab.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        subprocess.run((SETUP,), check=True, timeout=START_S)
