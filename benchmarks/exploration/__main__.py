"""The mission: `python -m benchmarks.exploration [--masters 2,3,4] [--losses 0,0.05] [--runs N] [--fill]`.

Two to four ROS masters, each in a network namespace of its own, on one emulated link; on each the same application
(`tests/udp_mesh/bridges/exploring_robot.py`), and as transport udp_mesh with the ROS 1 bridge, or the legacy transport
(`benchmarks.exploration.legacy_node`). Each phase of the mission ends when what it is for is done, or is given up after
`--limit` seconds. Bytes are those of IP that all computers sent, heartbeats and what was lost included. Needs root and
scripts/setup-ros. A finished cell is appended to the results at once, and is not run again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.link.laboratory import Laboratory, Link
from benchmarks.page import fill, this_machine
from tests.udp_mesh.bridges.bridge_processes import NodeProcess
from tests.udp_mesh.bridges.exploration import (
    ARTIFACT_BYTES,
    BASE,
    BEFORE,
    DURING,
    FIRST,
    MAP_BYTES,
    PRIORITIES,
    TOPICS,
    Application,
    bring_together,
    mission,
    team_names,
)
from tests.udp_mesh.bridges.interpreters import ROS_PYTHON
from tests.udp_mesh.bridges.ros1_processes import ROOT, Master
from tests.udp_mesh.bridges.ros_team import masters_on_one_link, team

RESULTS = Path(__file__).parents[1] / "results" / "exploration.jsonl"
RATE_BITS_PER_S, DELAY_MS = 5e6, 5.0
POLL_S = 0.2
UDP_MESH, LEGACY = "udp_mesh", "legacy transport"
TRANSPORTS = (UDP_MESH, LEGACY)
HOMEWARD = ("ferry out", "ferry home", "home")
"""The phases from the end of the cut until the base has everything."""


@contextmanager
def legacy_team(names: Sequence[str], link: Link) -> Iterator[tuple[Laboratory, list[Master]]]:
    """Masters of these names on one link, each with the legacy transport."""
    with masters_on_one_link(names, link) as (lab, masters), ExitStack() as kept:
        for place, master in enumerate(masters.values()):
            master.wait()
            others = [name for name in names if name != master.name]
            arguments = [master.name, lab.addresses[place], "10.99.0.255", json.dumps(PRIORITIES), *others]
            node = NodeProcess(
                [*master.inside, ROS_PYTHON, "-m", "benchmarks.exploration.legacy_node", *arguments],
                {**master.environment, "PYTHONPATH": str(ROOT)},
                master.folder / f"{master.name}-transport.log",
            )
            kept.callback(node.close)
        yield lab, list(masters.values())


@contextmanager
def transported(transport: str, names: Sequence[str], link: Link) -> Iterator[tuple[Laboratory, list[Master]]]:
    if transport == LEGACY:
        with legacy_team(names, link) as found:
            yield found
    else:
        with team(*names, link=link, topics=TOPICS) as (lab, members):
            yield lab, [member.master for member in members]


def measure(transport: str, masters: int, loss: float, cut_s: float, limit_s: float) -> dict[str, Any]:
    """One mission."""
    names = team_names(masters)
    link = Link(rate=RATE_BITS_PER_S, delay_ms=DELAY_MS, loss=loss)
    with transported(transport, names, link) as (lab, ros_masters), ExitStack() as kept:
        found = {}
        for master in ros_masters:
            found[master.name] = Application(master, master.name, names)
            kept.callback(found[master.name].close)
        _wait(lambda: all(len(each.hears()) == masters - 1 for each in found.values()), limit_s)
        lab.reset()
        phases = []
        for phase in mission(found, cut_s):
            bring_together(lab, names, phase.together)
            phase.begin()
            started_s, before = time.monotonic(), _sent_bytes(lab)
            is_done = _wait(phase.is_over, limit_s + (cut_s if phase.name == "cut" else 0.0))
            phases.append(
                {
                    "phase": phase.name,
                    "together": list(phase.together),
                    "is_done": is_done,
                    "seconds": round(time.monotonic() - started_s, 1),
                    "bytes": _sent_bytes(lab) - before,
                    "items_at_base": found[BASE].items(),
                }
            )
        report = found[BASE].report()
        return {
            "transport": transport,
            "masters": masters,
            "loss": loss,
            "cut_s": cut_s,
            "limit_s": limit_s,
            "phases": phases,
            "items": items_found(masters),
            "items_at_base": found[BASE].items(),
            "task_reached": found[FIRST].knows_the_task(),
            "task_known_as_taken": FIRST in report["taken"],
            "bytes": _sent_bytes(lab),
            "machine": this_machine(),
        }


def items_found(masters: int) -> int:
    """Artifacts and map differences, of all robots."""
    return 2 * ((masters - 1) * BEFORE + DURING)


def _sent_bytes(lab: Laboratory) -> int:
    """What all computers sent so far."""
    return sum(port.in_bytes for port in lab.count().ports)


def _wait(is_over: Callable[[], bool], limit_s: float) -> bool:
    end_s = time.monotonic() + limit_s
    while not (done := is_over()) and time.monotonic() < end_s:
        time.sleep(POLL_S)
    return done


def table(results: Sequence[dict[str, Any]]) -> str:
    """A row per kind of mission; medians of its runs."""
    lines = [
        "| masters | loss | transport | runs | first finds at the base | home after the cut | finds at the base "
        "| task taken, known at the base | sent, MB |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]

    def kind(result: dict[str, Any]) -> tuple[int, float, int]:
        return result["masters"], result["loss"], TRANSPORTS.index(result["transport"])

    for (masters, loss, transport), runs in itertools.groupby(sorted(results, key=kind), kind):
        same = list(runs)
        firsts = [result["phases"][:1] for result in same]
        homes = [[phase for phase in result["phases"] if phase["phase"] in HOMEWARD] for result in same]
        items = statistics.median_low(result["items_at_base"] for result in same)
        taken = sum(result["task_known_as_taken"] for result in same)
        sent_bytes = statistics.median(result["bytes"] for result in same)
        lines.append(
            f"| {masters} | {loss:.0%} | {TRANSPORTS[transport]} | {len(same)} | {_time(firsts)} | {_time(homes)} "
            f"| {items} of {same[0]['items']} | {taken} of {len(same)} | {sent_bytes / 1e6:.1f} |"
        )
    return "\n".join(lines)


def _time(runs: Sequence[Sequence[dict[str, Any]]]) -> str:
    """The median of the sums of these phases; one that was given up counts with the time until then."""
    median_s = statistics.median(sum(phase["seconds"] for phase in phases) for phases in runs)
    given_up = sum(not all(phase["is_done"] for phase in phases) for phases in runs)
    return f"{median_s:.0f} s" + (f", given up in {given_up} of {len(runs)}" if given_up else "")


def _is_same(result: dict[str, Any], cell: tuple[str, int, float], cut_s: float) -> bool:
    return (result["transport"], result["masters"], result["loss"], result["cut_s"]) == (*cell, cut_s)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.exploration", description=__doc__)
    parser.add_argument("--masters", default="2,3,4", help="how many masters, separated by commas (default: 2,3,4)")
    parser.add_argument("--losses", default="0,0.05", help="of the link in each direction (default: 0,0.05)")
    parser.add_argument("--transport", choices=TRANSPORTS, help="only this one")
    parser.add_argument("--cut", type=float, default=120.0, metavar="SECONDS", help="of the first robot (default: 120)")
    parser.add_argument("--limit", type=float, default=60.0, metavar="SECONDS", help="of each phase (default: 60)")
    parser.add_argument("--runs", type=int, default=1, help="of each cell (default: 1)")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    path: Path = arguments.results
    results = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    chosen = TRANSPORTS if arguments.transport is None else (arguments.transport,)
    masters = map(int, arguments.masters.split(","))
    losses = [float(loss) for loss in arguments.losses.split(",")]
    # round by round, so that the runs of a cell are spread over time
    cells = list(itertools.product(chosen, masters, losses))
    for run, (transport, count, loss) in itertools.product(range(arguments.runs), cells):
        if sum(_is_same(result, (transport, count, loss), arguments.cut) for result in results) > run:
            continue
        result = measure(transport, count, loss, arguments.cut, arguments.limit)
        results.append(result)
        with path.open("a") as file:
            file.write(json.dumps(result) + "\n")
        print(json.dumps(result), flush=True)
    shown = [result for result in results if (result["cut_s"], result["limit_s"]) == (arguments.cut, arguments.limit)]
    text = (
        f"Finds: artifacts of {ARTIFACT_BYTES / 1e3:.0f} kB and map differences of {MAP_BYTES / 1e3:.0f} kB. "
        f"Medians of the runs.\n\n{table(shown)}"
    )
    print(text)
    if arguments.fill:
        fill("exploration", text)


if __name__ == "__main__":
    main()
