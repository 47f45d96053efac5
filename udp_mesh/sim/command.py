"""`udp-mesh sim`: loads the scenario, runs it with progress, prints the summary, writes the results."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from udp_mesh.report.aggregate import parse
from udp_mesh.report.document import document_of
from udp_mesh.report.page import page_writer
from udp_mesh.sim.run import RunResult, play
from udp_mesh.sim.scenario import MAX_DURATION_S, Scenario, ScenarioError, load

SHIPPED = Path(__file__).with_name("scenarios")
NO_SCENARIO = "expected a scenario, found none; `udp-mesh sim --list` lists the shipped ones"


def run_command(arguments: Sequence[str]) -> int:
    """Exit codes: 0 success, 2 the scenario is invalid or the results cannot be written, 130 interrupted."""
    parser = argparse.ArgumentParser(
        prog="udp-mesh sim",
        description="Simulate a team in virtual time: the transport's core on a simulated radio channel.",
        epilog="exit codes: 0 success, 2 invalid scenario or results not writable, 130 interrupted\n\n"
        "`udp-mesh sim sweep --help`: many seeds and settings, compared with confidence intervals\n\n"
        "example: udp-mesh sim final-run --out /tmp/final-run",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scenario", nargs="?", help="scenario file (YAML), or name of a shipped scenario")
    parser.add_argument("--list", action="store_true", help="list the shipped scenarios and exit")
    parser.add_argument("--seed", type=_seed, help="override the scenario's seed")
    parser.add_argument(
        "--duration", type=_duration_s, metavar="SECONDS", help="override the scenario's duration (virtual time)"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="write recording.jsonl, summary.json and, with meshctl, report.html"
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    options = parser.parse_args(list(arguments))
    if options.list:
        print(*shipped(), sep="\n")
        return 0
    try:
        if options.scenario is None:
            raise ScenarioError(NO_SCENARIO)
        scenario = load(find(options.scenario))
        if options.seed is not None:
            scenario = replace(scenario, seed=options.seed)
        if options.duration is not None:
            scenario = replace(scenario, duration_s=options.duration)
        if options.out is not None:
            # Before the run, which may take long.
            _check_writable(options.out)
        result = play(scenario, _progress(scenario))
        if options.out is not None:
            write(result, options.out)
    except ScenarioError as error:
        print("\n".join(f"udp-mesh: {problem}" for problem in str(error).splitlines()), file=sys.stderr)
        return 2
    except OSError as error:
        print(f"udp-mesh: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    summary = result.summary()
    print(json.dumps(summary, indent=2) if options.json else text(summary))
    return 0


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, found {text!r}")
    return int(text)


def _duration_s(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1e-3 <= value <= MAX_DURATION_S:
        raise argparse.ArgumentTypeError(f"expected 0.001 to {MAX_DURATION_S:g} seconds, found {text!r}")
    return value


def _check_writable(directory: Path) -> None:
    """Raises OSError if the directory cannot be written."""
    directory.mkdir(parents=True, exist_ok=True)
    probe = directory / "recording.jsonl"
    with probe.open("ab"):
        pass
    if not probe.stat().st_size:
        probe.unlink()


def shipped() -> list[str]:
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def find(name: str) -> Path:
    """An existing path, or the path of a shipped scenario. Raises ScenarioError."""
    path = Path(name)
    if path.exists():
        return path
    if name in shipped():
        return SHIPPED / f"{name}.yaml"
    raise ScenarioError(f"{name}: expected a file or one of {', '.join(shipped())}, found neither")


def write(result: RunResult, directory: Path) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "recording.jsonl").write_text("\n".join(result.lines) + "\n", "utf-8")
    (directory / "summary.json").write_text(json.dumps(result.summary(), indent=2) + "\n", "utf-8")
    if (write_page := page_writer()) is not None:
        document = document_of(parse((line.encode() for line in result.lines), "recording.jsonl"))
        write_page([directory / "recording.jsonl"], [document], directory / "report.html", result.scenario.name)


def _progress(scenario: Scenario) -> Callable[[float], None]:
    """Shows the virtual time on a terminal."""
    if not sys.stderr.isatty():
        return lambda now: None

    def show(now: float) -> None:
        end = "\n" if now >= scenario.duration_s - 1 else ""
        sys.stderr.write(f"\r{scenario.name}: {now:.0f} of {scenario.duration_s:.0f} s{end}")

    return show


def _thin_lines(thin: dict[str, Any]) -> list[str]:
    return [
        f"thin link {name}: {link['frames']} frames, {link['collided']} collided, {link['lost']} lost; "
        f"the busiest robot used {link['budget_share']:.0%} of its {link['budget_s']:g} s of airtime per window"
        for name, link in thin.items()
    ]


def text(summary: dict[str, Any]) -> str:
    """The summary as text."""
    channel = summary["channel"]
    reasons = ", ".join(f"{count} {reason}" for reason, count in summary["rejected_because"].items())
    because = f" ({reasons})" if reasons else ""
    lines = [
        f"{summary['scenario']}, seed {summary['seed']}, {summary['duration_s']:.0f} s of virtual time",
        f"messages: {summary['accepted']} accepted, {summary['rejected']} refused{because}; per destination: "
        f"{summary['delivered']} delivered, {summary['expired']} expired, {summary['peer_lost']} lost with their peer",
        f"channel: busy {channel['airtime_share']:.0%} of the time, {channel['transmissions']} transmissions",
        *_thin_lines(summary["thin"]),
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
