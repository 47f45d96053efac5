"""`udp-mesh sim`: find the scenario, play it with progress, say what came of it, write what was asked for."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from udp_mesh.report.page import write_page
from udp_mesh.report.recording import parse
from udp_mesh.sim.run import Played, play
from udp_mesh.sim.scenario import Scenario, ScenarioError, load

SHIPPED = Path(__file__).with_name("scenarios")


def run_command(arguments: Sequence[str]) -> int:
    """0 played, 2 the scenario cannot be used, 130 interrupted."""
    parser = argparse.ArgumentParser(
        prog="udp-mesh sim",
        description="Play a whole team in virtual time, on the transport's own core and a simulated radio channel.",
        epilog="example: udp-mesh sim final-run --out /tmp/final-run",
    )
    parser.add_argument("scenario", nargs="?", help="a YAML file, or the name of a shipped scenario")
    parser.add_argument("--list", action="store_true", help="name the shipped scenarios and exit")
    parser.add_argument("--seed", type=int, help="instead of the scenario's own")
    parser.add_argument("--duration", type=float, metavar="S", help="virtual seconds, instead of the scenario's own")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write recording.jsonl, summary.json and report.html")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    chosen = parser.parse_args(list(arguments))
    if chosen.list or chosen.scenario is None:
        print(*shipped(), sep="\n")
        return 0 if chosen.list else 2
    try:
        scenario = load(find(chosen.scenario))
        if chosen.seed is not None:
            scenario = replace(scenario, seed=chosen.seed)
        if chosen.duration is not None:
            scenario = replace(scenario, duration_s=chosen.duration)
        played = play(scenario, _progress(scenario))
        if chosen.out is not None:
            write(played, chosen.out)
    except (ScenarioError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    summary = played.summary()
    print(json.dumps(summary, indent=2) if chosen.json else text(summary))
    return 0


def shipped() -> list[str]:
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def find(name: str) -> Path:
    """A path that exists, or a shipped scenario by its name; raises ScenarioError."""
    path = Path(name)
    if path.exists():
        return path
    if name in shipped():
        return SHIPPED / f"{name}.yaml"
    raise ScenarioError(f"{name}: expected a file or one of {', '.join(shipped())}, found neither")


def write(played: Played, directory: Path) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "recording.jsonl").write_text("\n".join(played.lines) + "\n")
    (directory / "summary.json").write_text(json.dumps(played.summary(), indent=2) + "\n")
    recorded = parse((line.encode() for line in played.lines), "recording.jsonl")
    write_page([recorded], directory / "report.html", title=played.scenario.name)


def _progress(scenario: Scenario) -> Callable[[float], None]:
    """A line that counts virtual time, on a terminal only."""
    if not sys.stderr.isatty():
        return lambda now: None

    def show(now: float) -> None:
        end = "\n" if now >= scenario.duration_s - 1 else ""
        sys.stderr.write(f"\r{scenario.name}: {now:.0f} of {scenario.duration_s:.0f} s{end}")

    return show


def text(summary: dict[str, Any]) -> str:
    """The summary for people."""
    channel = summary["channel"]
    lines = [
        f"{summary['scenario']}, seed {summary['seed']}, {summary['duration_s']:.0f} virtual seconds",
        f"messages: {summary['accepted']} accepted, {summary['rejected']} refused; per destination: "
        f"{summary['delivered']} delivered, {summary['expired']} expired, {summary['peer_lost']} lost with their peer",
        f"channel: busy {channel['airtime_share']:.0%} of the time, {channel['transmissions']} transmissions",
        f"{'topic':<14}{'offered':>9}{'arrived':>9}{'MB':>9}{'p50 ms':>9}{'p99 ms':>10}",
    ]
    for name, topic in summary["topics"].items():
        p50, p99 = (
            "-" if topic[key] is None else f"{topic[key] * 1e3:.0f}" for key in ("latency_p50_s", "latency_p99_s")
        )
        lines.append(
            f"{name:<14}{topic['offered']:>9}{topic['arrived']:>9}{topic['bytes'] / 1e6:>9.1f}{p50:>9}{p99:>10}"
        )
    return "\n".join(lines)
