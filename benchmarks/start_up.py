"""Start-up of the commands: `python -m benchmarks.start_up [--against DIR] [--fill]`.

Each command runs in a process of its own, in turns with the others, and `--against` compares with another checkout that
has its own `.venv`. The minimum of the runs is printed: other work on the machine only makes a start slower. CPU time
counts the process and its children. The bytecode of both checkouts is compiled first, as an installation does.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.page import fill, this_machine

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).with_name("results") / "start_up.jsonl"
RUNS = 15
_INVENTORY = str(ROOT / "inventory" / "lab")
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "python -c pass": ("python", "-c", "pass"),
    "meshctl --help": ("meshctl", "--help"),
    "meshctl --version": ("meshctl", "--version"),
    "meshctl lint inventory/lab": ("meshctl", "lint", _INVENTORY),
    "meshctl status --help": ("meshctl", "status", "--help"),
    "udp-mesh --help": ("udp-mesh", "--help"),
    "udp-mesh status, no daemon": ("udp-mesh", "status", "--socket", "/nonexistent"),
}


def started(checkout: Path, command: Sequence[str]) -> tuple[float, float]:
    """Wall and CPU seconds of one run."""
    program = checkout / ".venv" / "bin" / command[0]
    # cached bytecode, wherever this runs
    environ = {name: value for name, value in os.environ.items() if not name.startswith(("MESHCTL_", "PYTHON"))}
    began_s = time.monotonic()
    process = subprocess.Popen(
        [program, *command[1:]], cwd=checkout, env=environ, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return time.monotonic() - began_s, used.ru_utime + used.ru_stime


def measure(checkouts: Mapping[str, Path]) -> list[dict[str, Any]]:
    """One result per command and checkout."""
    for checkout in checkouts.values():
        packages = ["meshctl", "meshlab", "udp_mesh"]
        subprocess.run([checkout / ".venv/bin/python", "-m", "compileall", "-q", *packages], cwd=checkout, check=True)
    runs: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for _ in range(RUNS):
        for name, command in COMMANDS.items():
            for label, checkout in checkouts.items():
                runs.setdefault((name, label), []).append(started(checkout, command))
    return [
        {
            "command": name,
            "checkout": label,
            "seconds": min(wall_s for wall_s, _ in took),
            "cpu_s": min(cpu_s for _, cpu_s in took),
        }
        for (name, label), took in runs.items()
    ]


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: a row per command, with the ratio if there is a checkout to compare with."""
    found = {(result["command"], result["checkout"]): result for result in results}
    compared = any(result["checkout"] == "before" for result in results)
    heads = ["command", "seconds", "CPU seconds", *(["CPU seconds before", "ratio"] if compared else [])]
    lines = [f"| {' | '.join(heads)} |", f"| --- |{' ---: |' * (len(heads) - 1)}"]
    for name in COMMANDS:
        now = found[name, "now"]
        cells = [f"`{name}`", f"{now['seconds']:.3f}", f"{now['cpu_s']:.3f}"]
        if compared:
            before = found[name, "before"]
            cells += [f"{before['cpu_s']:.3f}", f"{now['cpu_s'] / before['cpu_s']:.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.start_up", description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout with its .venv, measured in the same run")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    checkouts = {"now": ROOT, **({"before": arguments.against.resolve()} if arguments.against else {})}
    results = measure(checkouts)
    machine = this_machine()
    arguments.results.write_text("".join(json.dumps({**machine, **result}) + "\n" for result in results))
    text = f"Python {machine['python']}, {machine['machine']}, {machine['cores']} cores\n\n{table(results)}"
    print(text)
    if arguments.fill:
        fill("start-up", text)


if __name__ == "__main__":
    main()
