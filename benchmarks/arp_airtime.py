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
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.page import fill
from benchmarks.practice_fleet import PracticeFleet, log, practice_fleet
from benchmarks.reconvergence_udp_mesh import airtime_us

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "arp_airtime.jsonl"
PAGE = ROOT / "docs" / "decisions" / "0012-arp.md"
PROGRAM = Path(__file__).with_name("in_machine") / "overhear_arp.py"
SCENARIOS = ("quiet", "pings", "one gone")
SCENARIO_S = 60
PING_EVERY_S = 5
# powered off in the last scenario: there is a path around it, so that only its own address is unanswered
POWERED_OFF_NODE = "b02"


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
    with tempfile.TemporaryDirectory() as folder, practice_fleet(Path(folder)) as lab:
        lab.machine(f"cat >/run/overhear_arp.py <<'END'\n{PROGRAM.read_text()}END")
        made = Bench(lab)
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
                        "nodes": len(lab.nodes),
                    }
                    line |= {**made.run_scenario(scene), "load": round(os.getloadavg()[0], 1)}
                    with results.open("a", encoding="utf-8") as file:
                        file.write(f"{json.dumps(line)}\n")
                    log(f"table {'on' if is_on else 'off'}, {scene}: {line['requests']} broadcasts")


@dataclass(frozen=True, slots=True)
class Bench:
    """The running fleet, seen from the operator's computer."""

    lab: PracticeFleet

    def set_table(self, *, is_on: bool) -> None:
        """Set the table on every node, which recreates bat0 with empty tables; then wait for the mesh."""
        words = f"uci set network.bat0.distributed_arp_table={is_on:d} && uci commit network && reload_config"
        self.lab.on_all(words)
        for name in self.lab.nodes:
            setting = self.lab.on(name, "batctl meshif bat0 distributed_arp_table").strip()
            if setting != ("enabled" if is_on else "disabled"):
                raise RuntimeError(f"{name}: its distributed ARP table is {setting}")
        self.lab.settle()

    def run_scenario(self, scene: str) -> dict[str, Any]:
        """The captured traffic: `overheard`, rows of kind, rate, bytes and count, and the number of `requests`."""
        if scene == "one gone":
            self.lab.fleet.inject_fault(POWERED_OFF_NODE, "off")
        self.lab.on_all("ip neigh flush all", but=POWERED_OFF_NODE if scene == "one gone" else "")
        for robot in self.lab.inventory.robots:
            self.lab.machine(f"ip netns exec pc.{robot} ip neigh flush all")
        try:
            # start the capture before any traffic
            self.lab.machine(f"python3 /run/overhear_arp.py {SCENARIO_S} >/run/arp.out 2>&1 </dev/null &")
            self.lab.until(lambda: self._capture().startswith("listening"), "the capture to start")
            if scene != "quiet":
                self.lab.machine("; ".join(self._ping(address) for address in self.lab.addresses))
            self.lab.until(lambda: "requests" in self._capture(), "the scenario to end")
            text = self._capture()
        finally:
            if scene == "one gone":
                self.lab.fleet.repair(POWERED_OFF_NODE)
                self.lab.settle()
        _, *lines, last = text.splitlines()
        overheard = [
            {"kind": kind, "rate": int(rate), "bytes": int(length), "count": int(count)}
            for kind, rate, length, count in map(str.split, lines)
        ]
        return {"requests": int(last.split()[1]), "overheard": overheard}

    def _ping(self, address: str) -> str:
        # with its own deadline ping would end at the first address that does not answer
        words = f"timeout {SCENARIO_S} ping -q -i {PING_EVERY_S} {address}"
        return f"(ip netns exec pc.{self.lab.operator} {words} >/dev/null 2>&1 </dev/null &)"

    def _capture(self) -> str:
        return self.lab.machine("cat /run/arp.out")


# -- results --


def recorded(path: Path) -> list[dict[str, Any]]:
    """Every recorded run, in order."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def runs_of(results: list[dict[str, Any]], scene: str, *, is_on: bool) -> list[dict[str, Any]]:
    return [result for result in results if (result["scene"], result["table"]) == (scene, is_on)]


def air_us(result: dict[str, Any], *kinds: str) -> float:
    """Airtime of frames of these kinds, in microseconds; unicast frames are acknowledged."""
    total_us: float = sum(
        item["count"]
        * airtime_us(item["rate"], item["bytes"], "probe" if item["kind"] in ("unicast", "table") else "ogm")
        for item in result["overheard"]
        if item["kind"] in kinds
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
        each: list[float] = [count(run) * 60 / run["seconds"] for run in runs]
        return statistics.median(each)

    def frames(*kinds: str) -> float:
        return per_minute(lambda result: sum(item["count"] for item in result["overheard"] if item["kind"] in kinds))

    size = per_minute(
        lambda result: sum(item["count"] * item["bytes"] for item in result["overheard"] if item["kind"] in ARP)
    )
    shares = (
        statistics.median(air_us(run, *kinds) / (run["seconds"] * 1e6) for run in runs) for kinds in (ARP, ("ogm",))
    )
    counts = (per_minute(lambda result: result["requests"]), frames("broadcast"), frames("unicast", "table"), size)
    return " | ".join((*(f"{count:.0f}" for count in counts), *(f"{share:.3%}" for share in shares)))


if __name__ == "__main__":
    main()
