"""Airtime of ARP, with batman-adv's distributed ARP table off and on: `python -m benchmarks.arp_airtime [--fill]`.

The lab's example fleet (six nodes, three computers) is provisioned on the kernel's 802.11 radios, then, for each
setting of `distributed_arp_table` on all nodes (`Bench.set_table`) and each scenario:

    flush ARP caches -> capture the channel while the operator's computer runs the scenario -> one line of results

`quiet`: no traffic. `pings`: the operator's computer pings every node and every other computer every five seconds, as
monitoring would. `one gone`: the same, with one node powered off.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.page import fill
from benchmarks.reconvergence_udp_mesh import airtime_us
from meshctl.errors import MeshctlError
from meshctl.model import Fleet
from meshlab.fleet import QemuFleet
from meshlab.from_inventory import spec_of
from meshlab.inventory_copy import copy_inventory
from meshlab.qemu import control

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "arp_airtime.jsonl"
PAGE = ROOT / "docs" / "decisions" / "0012-arp.md"
PROGRAM = Path(__file__).with_name("in_machine") / "overhear_arp.py"
SCENARIOS = ("quiet", "pings", "one gone")
SCENARIO_S = 60
PING_EVERY_S = 5
# powered off in the last scenario: there is a path around it, so that only its own address is unanswered
POWERED_OFF_NODE = "b02"
# under emulation on a busy host; loop avoidance alone holds a new bat0 for half a minute
_START_S, _COMMAND_S, _SETTLE_S = 600.0, 900.0, 240.0
_POLL_S = 0.5
_WINDOW_S = 600
# a connection into a starved machine may break; all commands are safe to repeat
_ATTEMPTS = 3


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.arp_airtime", description=__doc__)
    parser.add_argument("--runs", type=int, default=2, help="number of runs of each scenario")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    parser.add_argument("--fill", action="store_true", help=f"write the table to {PAGE.relative_to(ROOT)}")
    arguments = parser.parse_args()
    if not arguments.tables:
        measure(arguments.results, arguments.runs)
    text = table(recorded(arguments.results))
    print(text)
    if arguments.fill:
        fill("arp_airtime", text, PAGE)


# -- measuring --


def measure(results: Path, runs: int) -> None:
    """Append the missing runs of every scenario to the results, each as soon as it was measured."""
    with tempfile.TemporaryDirectory() as folder, bench(Path(folder)) as made:
        for _ in range(runs):
            for is_on in (False, True):
                todo = [scene for scene in SCENARIOS if len(runs_of(recorded(results), scene, is_on=is_on)) < runs]
                if not todo:
                    continue
                made.set_table(is_on=is_on)
                for scene in todo:
                    line: dict[str, Any] = {
                        "table": is_on,
                        "scene": scene,
                        "seconds": SCENARIO_S,
                        "nodes": len(made.nodes),
                    }
                    line |= {**made.run_scenario(scene), "load": round(os.getloadavg()[0], 1)}
                    with results.open("a", encoding="utf-8") as file:
                        file.write(f"{json.dumps(line)}\n")
                    _log(f"table {'on' if is_on else 'off'}, {scene}: {line['requests']} broadcasts")


@contextmanager
def bench(place: Path) -> Iterator[Bench]:
    """The example fleet, provisioned and unplugged."""
    copy = copy_inventory(ROOT / "inventory" / "lab", place / "lab")
    # confirming a change takes seconds, but minutes in an emulated machine on a starved host
    file = copy.inventory / "fleet.yaml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("confirm_window_s: 90", f"confirm_window_s: {_WINDOW_S}"), encoding="utf-8")
    fleet = QemuFleet(spec_of(copy.fleet, links=copy.links), place / "lab").up(wait_s=_START_S)
    try:
        made = Bench(fleet, copy.fleet, copy.inventory, place / "state")
        made.provision()
        yield made
    finally:
        fleet.down()


class Bench:
    """The running fleet, seen from the operator's computer."""

    def __init__(self, fleet: QemuFleet, inventory: Fleet, path: Path, state: Path) -> None:
        self._fleet = fleet
        self._inventory = inventory
        self._path = path
        self._state = state
        self.nodes = fleet.spec.names
        robots = inventory.robots.values()
        self._operator = next(robot.name for robot in robots if robot.is_base)
        computers = [robot.computer.address.ip for robot in robots if robot.computer and not robot.is_base]
        self._addresses = [str(one) for one in (*(inventory.nodes[name].address.ip for name in self.nodes), *computers)]

    def provision(self) -> None:
        environment = {
            **os.environ,
            "MESHCTL_LAB": str(self._fleet.directory),
            "MESHCTL_INVENTORY": str(self._path),
            "XDG_STATE_HOME": str(self._state),
        }
        left = list(self.nodes)
        for _ in range(_ATTEMPTS):
            words = (sys.executable, "-m", "meshctl", "bootstrap", "--yes", *left)
            subprocess.run(words, env=environment, check=False, timeout=_COMMAND_S, stdout=subprocess.DEVNULL)
            # on a starved machine, nodes that were proven too late have rolled back
            left = [
                name for name in left if self._fleet.node(name).address != str(self._inventory.nodes[name].address.ip)
            ]
            if not left:
                break
        else:
            raise RuntimeError(f"cannot provision {', '.join(left)}")
        for name in self.nodes:
            self._fleet.node(name).plug(False)
        control.run(self._fleet.directory, f"cat >/run/overhear_arp.py <<'END'\n{PROGRAM.read_text()}END").check("put")

    def set_table(self, *, is_on: bool) -> None:
        """Set the table on every node, which recreates bat0 with empty tables; then wait for the mesh."""
        words = f"uci set network.bat0.distributed_arp_table={is_on:d} && uci commit network && reload_config"
        self._on_all(words)
        for name in self.nodes:
            setting = self._on(name, "batctl meshif bat0 distributed_arp_table").strip()
            if setting != ("enabled" if is_on else "disabled"):
                raise RuntimeError(f"{name}: its distributed ARP table is {setting}")
        self._settle()

    def run_scenario(self, scene: str) -> dict[str, Any]:
        """The captured traffic: `overheard`, rows of kind, rate, bytes and count, and the number of `requests`."""
        if scene == "one gone":
            self._fleet.inject_fault(POWERED_OFF_NODE, "off")
        self._on_all("ip neigh flush all", but=POWERED_OFF_NODE if scene == "one gone" else "")
        for robot in self._inventory.robots:
            self._machine(f"ip netns exec pc.{robot} ip neigh flush all")
        try:
            # start the capture before any traffic
            self._machine(f"python3 /run/overhear_arp.py {SCENARIO_S} >/run/arp.out 2>&1 </dev/null &")
            self._until(lambda: self._capture().startswith("listening"), "the capture to start")
            if scene != "quiet":
                self._machine("; ".join(self._ping(address) for address in self._addresses))
            self._until(lambda: "requests" in self._capture(), "the scenario to end")
            text = self._capture()
        finally:
            if scene == "one gone":
                self._fleet.repair(POWERED_OFF_NODE)
                self._settle()
        _, *lines, last = text.splitlines()
        overheard = [
            {"kind": kind, "rate": int(rate), "bytes": int(length), "count": int(count)}
            for kind, rate, length, count in map(str.split, lines)
        ]
        return {"requests": int(last.split()[1]), "overheard": overheard}

    def _ping(self, address: str) -> str:
        # with its own deadline ping would end at the first address that does not answer
        words = f"timeout {SCENARIO_S} ping -q -i {PING_EVERY_S} {address}"
        return f"(ip netns exec pc.{self._operator} {words} >/dev/null 2>&1 </dev/null &)"

    def _capture(self) -> str:
        return self._machine("cat /run/arp.out")

    def _settle(self) -> None:
        def answers(address: str) -> bool:
            words = f"ip netns exec pc.{self._operator} ping -c 1 -W 2 {address}"
            return control.run(self._fleet.directory, words, timeout_s=60.0).exit_status == 0

        self._until(lambda: all(self._fleet.node(name).is_up() for name in self.nodes), "every node to be up")
        for address in self._addresses:
            self._until(lambda address=address: answers(address), f"{address} to answer")  # type: ignore[misc]

    def _until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + _SETTLE_S
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {_SETTLE_S:.0f} s for {what}")
            time.sleep(_POLL_S)

    def _on_all(self, command: str, *, but: str = "") -> None:
        names = [name for name in self.nodes if name != but]
        with ThreadPoolExecutor(len(names)) as pool:
            list(pool.map(lambda name: self._on(name, command), names))

    def _on(self, name: str, command: str) -> str:
        for left in reversed(range(_ATTEMPTS)):
            try:
                return self._fleet.node(name).exec(command, timeout_s=120.0).check(f"{name}: {command}").stdout
            except MeshctlError as error:
                if not left:
                    raise
                _log(f"{name}: {error}; again")
        raise AssertionError("no attempt was made")

    def _machine(self, command: str, *, timeout_s: float = 60.0) -> str:
        return control.run(self._fleet.directory, command, timeout_s=timeout_s).check(command[:80]).stdout


def _log(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S', time.gmtime())} {text}", file=sys.stderr, flush=True)


# -- results --


def recorded(path: Path) -> list[dict[str, Any]]:
    """Every recorded run, in order."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def runs_of(results: list[dict[str, Any]], scene: str, *, is_on: bool) -> list[dict[str, Any]]:
    return [one for one in results if (one["scene"], one["table"]) == (scene, is_on)]


def air_us(result: dict[str, Any], *kinds: str) -> float:
    """Airtime of frames of these kinds, in microseconds; unicast frames are acknowledged."""
    total_us: float = sum(
        one["count"] * airtime_us(one["rate"], one["bytes"], "probe" if one["kind"] in ("unicast", "table") else "ogm")
        for one in result["overheard"]
        if one["kind"] in kinds
    )
    return total_us


ARP = ("broadcast", "unicast", "table")


def table(results: list[dict[str, Any]]) -> str:
    """One row per scenario and setting: medians of the runs, per minute."""
    lines = [
        "| scene | table | runs | ARP broadcasts | their transmissions | other ARP frames | ARP, bytes "
        "| ARP, of the air | OGMs, of the air |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for scene in SCENARIOS:
        for is_on in (False, True):
            runs = runs_of(results, scene, is_on=is_on)
            cells = _cells(runs) if runs else "not measured | - | - | - | - | -"
            lines.append(f"| {scene} | {'on' if is_on else 'off'} | {len(runs)} | {cells} |")
    return "\n".join(lines)


def _cells(runs: list[dict[str, Any]]) -> str:
    def per_minute(count: Callable[[dict[str, Any]], float]) -> float:
        each: list[float] = [count(one) * 60 / one["seconds"] for one in runs]
        return statistics.median(each)

    def frames(*kinds: str) -> float:
        return per_minute(lambda one: sum(item["count"] for item in one["overheard"] if item["kind"] in kinds))

    size = per_minute(
        lambda one: sum(item["count"] * item["bytes"] for item in one["overheard"] if item["kind"] in ARP)
    )
    shares = (
        statistics.median(air_us(one, *kinds) / (one["seconds"] * 1e6) for one in runs) for kinds in (ARP, ("ogm",))
    )
    counts = (per_minute(lambda one: one["requests"]), frames("broadcast"), frames("unicast", "table"), size)
    return " | ".join((*(f"{count:.0f}" for count in counts), *(f"{share:.3%}" for share in shares)))


if __name__ == "__main__":
    main()
