"""Wall and CPU time per node: `meshctl provision` against the same files pushed by ansible-core.

`python -m benchmarks.provisioning [--nodes 10,50,200] [--model 80,200] [--forks N] [--parallel N] [--results FILE]
[--tables]` changes every node of a fleet from configuration `a` to `b` with meshctl, and back with ansible's `raw` and
`script` modules (dropbear has no SFTP and the nodes have no Python). Neither waits for one node before the next. They
do not do the same: ansible writes the files, reloads and checks that the files exist; meshctl also observes first,
keeps the previous state under a dead-man's switch, proves the node reachable with a new connection, checks its mesh,
and confirms.

`--nodes`: a virtual fleet of each size, bootstrapped first; all nodes run on this machine and wall time includes them.
`--model`: model nodes (`benchmarks.model_node`), which answer at the pace of a router and cost this machine almost
nothing; the processes and syncs that a change needs on a node are printed beside the times. Without `--parallel`
meshctl runs with its defaults; ansible's default is 5 forks. CPU time is the tool's own.

It runs unattended: every command has a time limit (`LIMIT_S`, `LIMIT_PER_NODE_S`), a size that fails is reported and
the next one starts, and each result is written immediately. It needs ansible-core beside this interpreter (the extra
`bench`).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.model_node.counting import counted
from benchmarks.model_node.fleet import ModelFleet
from benchmarks.page import append_result, read_results
from meshctl.errors import MeshctlError
from meshlab.fleet import VirtualFleet
from tests.meshctl.proof.rig import Rig

RESULTS = Path(__file__).with_name("results") / "provisioning.jsonl"
ANSIBLE = Path(sys.executable).with_name("ansible-playbook")
# ansible-core's default
FORKS = 5
# several times the time of either tool on two cores; a longer run hangs
LIMIT_S, LIMIT_PER_NODE_S = 120.0, 15.0
PLAYBOOK = """\
- hosts: all
  gather_facts: false
  tasks:
    - raw: cat /etc/openwrt_release
    - script: "{{ inventory_hostname }}.sh"
    - raw: test "$(sha256sum </etc/config/wireless)" = "{{ wireless_sha256 }}  -"
"""


def ran(command: Sequence[str], environ: Mapping[str, str], limit_s: float) -> dict[str, float]:
    """Run to its end; seconds of wall and processor time, of the process and all that it waited for.

    Raises RuntimeError when it fails, or has not ended after `limit_s`.
    """
    began = time.monotonic()
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, env=dict(environ), stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        limit = threading.Timer(limit_s, process.kill)
        limit.start()
        try:
            _, status, used = os.wait4(process.pid, 0)
        finally:
            limit.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode == -signal.SIGKILL:
            raise RuntimeError(f"{command[0]} did not finish within {limit_s:.0f} s")
        if process.returncode:
            output.seek(0)
            raise RuntimeError(f"{command[0]} ended with {process.returncode}:\n{output.read().decode()[-3000:]}")
    return {"seconds": time.monotonic() - began, "cpu_s": used.ru_utime + used.ru_stime}


def by_meshctl(inventory: Path, key: Path, environ: Mapping[str, str], count: int) -> dict[str, float]:
    command = [sys.executable, "-m", "meshctl", "provision", "--yes", "--json", "-i", str(inventory)]
    return ran([*command, "--key", str(key)], environ, limit_s(count))


def limit_s(count: int) -> float:
    return LIMIT_S + LIMIT_PER_NODE_S * count


@dataclass(frozen=True, slots=True)
class Host:
    """Where ansible reaches a node, and the files that it pushes there."""

    address: str
    port: int
    files: Mapping[str, bytes]


def by_ansible(directory: Path, hosts: Mapping[str, Host], environ: Mapping[str, str], forks: int) -> dict[str, float]:
    """Push the same files with one script per node, as an operator would write it."""
    place = directory / "ansible"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    listed = {}
    for name, host in hosts.items():
        (place / f"{name}.sh").write_text(script(host.files))
        listed[name] = {
            "ansible_host": host.address,
            "ansible_port": host.port,
            "wireless_sha256": _sha256(host.files["etc/config/wireless"]),
        }
    (place / "hosts.json").write_text(json.dumps({"all": {"hosts": listed}}))
    (place / "play.yaml").write_text(PLAYBOOK)
    settings = {
        **environ,
        "ANSIBLE_HOST_KEY_CHECKING": "False",
        "ANSIBLE_PIPELINING": "True",
        "ANSIBLE_SSH_TRANSFER_METHOD": "piped",
        "ANSIBLE_SSH_USETTY": "False",
        "ANSIBLE_REMOTE_USER": "root",
        "ANSIBLE_PRIVATE_KEY_FILE": str(directory / "key"),
        "ANSIBLE_SSH_ARGS": "-o ControlMaster=auto -o ControlPersist=30s -o UserKnownHostsFile=/dev/null",
        "ANSIBLE_HOME": str(place / "home"),
        "LC_ALL": "C.UTF-8",
    }
    command = [str(ANSIBLE), "-i", str(place / "hosts.json"), "--forks", str(forks), str(place / "play.yaml")]
    return ran(command, settings, limit_s(len(hosts)))


def script(files: Mapping[str, bytes]) -> str:
    """A shell script that writes these files and has OpenWrt reload what changed."""
    lines = ["#!/bin/sh", "set -e"]
    for path, content in sorted(files.items()):
        target = shlex.quote(f"/{path}")
        lines.append(f"mkdir -p {shlex.quote('/' + str(Path(path).parent))}")
        lines.append(f"printf %s {shlex.quote(content.decode())} >{target}.new && mv {target}.new {target}")
    return "\n".join([*lines, "sync", "reload_config"]) + "\n"


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _address(fleet: VirtualFleet, name: str) -> str:
    address = fleet.node(name).address
    if address is None:
        raise RuntimeError(f"{name} has no address")
    return address


def measure(count: int, forks: int, parallel: int | None) -> dict[str, Any]:
    """Run both tools on one virtual fleet of `count` nodes and a base."""
    with tempfile.TemporaryDirectory(prefix="provisioning-") as directory, Rig(
        Path(directory), count - 1, window_s=60, parallel=parallel
    ) as rig:  # fmt: skip
        taken = rig.take_in("a")
        if taken.code:
            raise RuntimeError(f"cannot bootstrap the fleet:\n{taken.out}{taken.err}")
        names = ("base", *rig.names)
        before = _node_count(rig.fleet, "n001")
        ours = by_meshctl(rig.inventory("b"), rig.directory / "key", rig.environ, count)
        after = _node_count(rig.fleet, "n001")
        hosts = {
            name: Host(endpoint.host, endpoint.port, rig.rendered("a", name, ""))
            for name in names
            for endpoint in (rig.fleet.endpoint(_address(rig.fleet, name)),)
        }
        ansible = by_ansible(rig.directory, hosts, rig.environ, forks)
        wrong = [name for name in names if rig.state_of(name, "b", "a") != "new"]
        if wrong:
            raise RuntimeError(f"ansible did not change {', '.join(wrong)}")
    ours.update({key: after[key] - before[key] for key in after})
    return {
        "fleet": "virtual",
        "nodes": count,
        "forks": forks,
        "parallel": parallel,
        "meshctl": ours,
        "ansible": ansible,
    }


def measure_model(count: int, forks: int, parallel: int | None) -> dict[str, Any]:
    """Run both tools on `count` model nodes."""
    with tempfile.TemporaryDirectory(prefix="provisioning-") as text:
        directory = Path(text)
        ours, counted = {}, {}
        fleet = ModelFleet(directory, count, parallel=parallel)
        with fleet.running() as nodes:
            ours = by_meshctl(fleet.inventory("b"), fleet.key, fleet.environ, count)
            counted = nodes.counts()
            hosts = {name: Host("127.0.0.1", fleet.ports[name], fleet.rendered("a", name)) for name in fleet.names}
            ansible = by_ansible(directory, hosts, fleet.environ, forks)
            changed = nodes.counts()
    ours.update(counted)
    ansible.update({key: changed[key] - counted[key] for key in changed})
    return {"fleet": "model", "nodes": count, "forks": forks, "parallel": parallel, "meshctl": ours, "ansible": ansible}


def _node_count(fleet: VirtualFleet, name: str) -> dict[str, float]:
    found = counted(fleet.node(name))
    return {"processes": found.processes, "syncs": found.syncs}


def table(results: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| nodes | tool | seconds | ratio | processor seconds per node | processes on a node | syncs on a node |",
        "| ---: | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for result in results:
        for tool in ("meshctl", "ansible"):
            took, nodes = result[tool], result["nodes"]
            width = result["forks"] if tool == "ansible" else result["parallel"]
            name = f"{tool}{'' if width is None else f', {width} at once'}"
            lines.append(
                f"| {nodes} {result['fleet']} | {name} | {took['seconds']:.1f} "
                f"| {took['seconds'] / result['ansible']['seconds']:.2f} | {took['cpu_s'] / nodes:.3f} "
                f"| {_number(took.get('processes'))} | {_number(took.get('syncs'))} |"
            )
    return "\n".join(lines)


def _number(found: float | None) -> str:
    return "" if found is None else f"{found:.0f}"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.provisioning", description=__doc__)
    parser.add_argument("--nodes", default="10,50,200", help="sizes of the virtual fleets; empty for none")
    parser.add_argument("--model", default="80,200", help="sizes of the fleets of model nodes; empty for none")
    parser.add_argument("--forks", type=int, default=FORKS, help="nodes that ansible works on at once")
    parser.add_argument("--parallel", type=int, help="`apply.parallel` of meshctl's inventory; default: not set")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    arguments = parser.parse_args()
    if arguments.tables:
        print(table(recorded(arguments.results)))
        return 0
    if not ANSIBLE.exists():
        parser.error(f"{ANSIBLE} is not there: install the extra `bench` beside this interpreter")
    failed = 0
    sizes = [(measure_model, count) for count in sizes_of(arguments.model)]
    sizes += [(measure, count) for count in sizes_of(arguments.nodes)]
    for run, count in sizes:
        try:
            result = run(count, arguments.forks, arguments.parallel)
        except (RuntimeError, MeshctlError, subprocess.TimeoutExpired) as error:
            failed += 1
            print(f"{count} nodes: {error}", file=sys.stderr, flush=True)
            continue
        append_result(arguments.results, result)
        print(table([result]), flush=True)
    print(table(recorded(arguments.results)))
    return 1 if failed else 0


def sizes_of(text: str) -> list[int]:
    return [int(word) for word in text.split(",") if word]


def recorded(path: Path) -> list[dict[str, Any]]:
    """The latest result of each fleet, size and concurrency."""
    found = read_results(path)
    return list({(r["fleet"], r["nodes"], r["forks"], r["parallel"]): r for r in found if "fleet" in r}.values())


if __name__ == "__main__":
    sys.exit(main())
