"""Duration of `meshctl status` for a fleet: `python -m benchmarks.status_scale [--radios 50,200] [--robots 20]
[--against DIR]`.

The devices are those of `status_fleet`: real SSH servers in their own network namespace, with prepared answers. The
command runs in a separate process, over real connections:

- once for the radios alone, and once for radios and robots, with new connections to all;
- the rounds of `--watch` after the first, with established connections;
- once while half of the radios are off: packets to them are lost, as in the field.

`--against` runs the same, in turns, with the meshctl of another checkout that has its own `.venv`.

Devices and meshctl share this machine's CPUs, so the wall time includes the devices' work. The CPU time of each is
measured: on a fleet of real devices only meshctl's is spent here.
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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.page import fill, this_machine
from benchmarks.status_fleet import Devices, process_cpu_s, programs_missing
from meshctl.device.observe import observation_script

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).with_name("results") / "status_scale.jsonl"
RUNS = 2
WATCH_ROUNDS = 4
ROWS = ("near", "all")


def run(command: Sequence[str], environ: Mapping[str, str]) -> tuple[float, float, dict[str, Any]]:
    """Wall and CPU seconds of a status, and its output."""
    began = time.monotonic()
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, env=dict(environ), stdin=subprocess.DEVNULL, stdout=output, stderr=errors)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        took_s = time.monotonic() - began
        output.seek(0)
        errors.seek(0)
        text = output.read()
        if not text:
            raise RuntimeError(f"status exited with {process.returncode}: {errors.read().decode()[-2000:]}")
    return took_s, used.ru_utime + used.ru_stime, json.loads(text)


def repeated(
    devices: Devices, commands: Mapping[str, Sequence[str]], environ: Mapping[str, str], answering: int
) -> dict[str, dict[str, float]]:
    """The median of several runs of each command, in turns. Raises RuntimeError unless exactly `answering` devices
    answered in each."""
    found: dict[str, list[tuple[float, float, float]]] = {label: [] for label in commands}
    for _ in range(RUNS):
        for label, command in commands.items():
            before_s = devices.cpu_s()
            wall_s, cpu_s = answered(command, environ, answering)
            found[label].append((wall_s, cpu_s, devices.cpu_s() - before_s))
    return {label: {**_medians(runs), "answering": answering} for label, runs in found.items()}


def _medians(runs: Sequence[tuple[float, float, float]]) -> dict[str, float]:
    seconds, cpu_s, devices_cpu_s = map(statistics.median, zip(*runs, strict=True))
    return {"seconds": seconds, "cpu_s": cpu_s, "devices_cpu_s": devices_cpu_s}


def answered(command: Sequence[str], environ: Mapping[str, str], answering: int) -> tuple[float, float]:
    """Wall and CPU seconds of a status. Raises RuntimeError unless exactly `answering` devices answered."""
    wall_s, cpu_s, document = run(command, environ)
    devices = [*document["nodes"], *document["robots"]]
    count = sum(device["answers"] for device in devices)
    if count != answering:
        why = {device["silent_because"] for device in devices if not device["answers"]}
        raise RuntimeError(f"{count} of {len(devices)} answered, expected {answering}: {why}")
    return wall_s, cpu_s


def watched(devices: Devices, command: Sequence[str], environ: Mapping[str, str]) -> dict[str, float]:
    """The rounds of `--watch` after the first: their duration by the command itself, and the CPU time of both sides."""
    with subprocess.Popen(
        [*command, "--watch", "1"],
        env=dict(environ),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        before = process_cpu_s(process.pid), devices.cpu_s()
        looks = [json.loads(process.stdout.readline()) for _ in range(WATCH_ROUNDS)]
        after = process_cpu_s(process.pid), devices.cpu_s()
        process.terminate()
        process.wait(60)
    asked = len(first["nodes"]) + len(first["robots"])
    silent = [device["name"] for look in looks for device in (*look["nodes"], *look["robots"]) if not device["answers"]]
    if silent or not asked:
        raise RuntimeError(f"without an answer: {silent}")
    cpu_s, devices_cpu_s = ((late - early) / WATCH_ROUNDS for early, late in zip(before, after, strict=True))
    seconds = statistics.median(look["took_s"] for look in looks)
    return {"seconds": seconds, "cpu_s": cpu_s, "devices_cpu_s": devices_cpu_s}


def measure(radios: int, robots: int, checkouts: Mapping[str, str]) -> list[dict[str, Any]]:
    """All figures for one fleet, whose radios include the base, by checkout."""
    with tempfile.TemporaryDirectory(prefix="status-scale-") as directory:
        devices = Devices(Path(directory, "fleet"), radios, robots)
        devices.directory.mkdir()
        ours = {name: value for name, value in os.environ.items() if not name.startswith("MESHCTL_")}
        environ = {**ours, "XDG_STATE_HOME": str(Path(directory, "state")), "SSH_AUTH_SOCK": ""}
        commands = {
            label: [f"{checkout}/.venv/bin/meshctl", "status", "--json", "-i", str(devices.inventory)]
            for label, checkout in checkouts.items()
        }
        try:
            devices.start()
            without_robots = {label: [*command, "--no-robots"] for label, command in commands.items()}
            alone = repeated(devices, without_robots, environ, radios)
            both = repeated(devices, commands, environ, radios + robots)
            again = {label: watched(devices, command, environ) for label, command in commands.items()}
            off = devices.switch_off_half()
            half = repeated(devices, commands, environ, radios + robots - off)
            answers = {
                "script": len(observation_script("0" * 40)),
                **{rows: devices.answer_bytes(rows) for rows in ROWS},
            }
        finally:
            devices.stop()
    phases = {"alone": alone, "both": both, "again": again, "half": half}
    return [
        {
            "radios": radios,
            "robots": robots,
            "checkout": label,
            "bytes": answers,
            **{name: values[label] for name, values in phases.items()},
        }
        for label in commands
    ]


_ROWS = {
    "alone": "radios alone, all answer",
    "both": "radios and robots, all answer",
    "again": "the same, connections kept (`--watch`)",
    "half": "half of the radios off",
}


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| radios | robots | query | revision | seconds | processor seconds of meshctl | of the devices |",
        "| ---: | ---: | --- | --- | ---: | ---: | ---: |",
    ]
    for radios, robots in dict.fromkeys((result["radios"], result["robots"]) for result in results):
        for key, what in _ROWS.items():
            for result in results:
                if (result["radios"], result["robots"]) == (radios, robots):
                    took = result[key]
                    measured = (f"{took[name]:.2f}" for name in ("seconds", "cpu_s", "devices_cpu_s"))
                    cells = (radios, robots, what, result["checkout"], *measured)
                    lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def sizes(results: Sequence[Mapping[str, Any]]) -> str:
    """What a look at one radio sends, as Markdown."""
    lines = [
        "| radios | the script, bytes | an answer with all originators, compressed | with the rows of neighbors |",
        "| ---: | ---: | ---: | ---: |",
    ]
    sent = {result["radios"]: result["bytes"] for result in results}
    lines += [f"| {radios} | {size['script']} | {size['all']} | {size['near']} |" for radios, size in sent.items()]
    return "\n".join(lines)


def in_own_network(radios: int, robots: int, checkouts: Mapping[str, str]) -> list[dict[str, Any]]:
    """Run `measure` in a separate process, in a network namespace with only the fleet's addresses."""
    inner = 'ip link set lo up && exec "$@"'
    command = ["unshare", "--net", "sh", "-ec", inner, "sh", sys.executable, "-m", "benchmarks.status_scale"]
    inside = json.dumps([radios, robots, checkouts])
    done = subprocess.run([*command, "--inside", inside], stdout=subprocess.PIPE, check=True)
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.status_scale", description=__doc__)
    parser.add_argument("--radios", default="50,200")
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--against", type=Path, help="another checkout with its .venv, measured in the same run")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    parser.add_argument("--inside", default="", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inside:
        print(json.dumps(measure(*json.loads(arguments.inside))))
        return
    known = (
        [json.loads(line) for line in arguments.results.read_text().splitlines()] if arguments.results.exists() else []
    )
    results = {(result["radios"], result["robots"], result.get("checkout", "now")): result for result in known}
    if not arguments.tables:
        if missing := programs_missing():
            parser.error(f"it needs {', '.join(missing)}")
        machine = this_machine()
        before = {"before": str(arguments.against.resolve())} if arguments.against else {}
        checkouts = {**before, "now": str(ROOT)}
        for radios in map(int, arguments.radios.split(",")):
            for found in in_own_network(radios, arguments.robots, checkouts):
                results[radios, arguments.robots, found["checkout"]] = {**machine, **found}
            arguments.results.parent.mkdir(parents=True, exist_ok=True)
            arguments.results.write_text("".join(json.dumps(result) + "\n" for result in results.values()))
    rows = [results[key] for key in sorted(results)]
    first = rows[0]
    heading = f"Python {first['python']}, {first['machine']}, {first['cores']} cores for meshctl and all devices"
    text = f"{heading}\n\n{table(rows)}\n\n{sizes(rows)}"
    print(text)
    if arguments.fill:
        fill("status", text)


if __name__ == "__main__":
    main()
