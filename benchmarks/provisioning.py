"""Wall and CPU time per node: `meshctl provision` against the same files pushed by ansible-core.

`python -m benchmarks.provisioning [--nodes 10,50,200] [--results FILE] [--tables]` starts a virtual fleet of each size,
bootstraps it, and then changes every node twice: from configuration `a` to `b` with meshctl, and from `b` back to `a`
with ansible's `raw` and `script` modules (dropbear has no SFTP and the nodes have no Python). Both use the same number
of parallel connections, and neither waits for one node before the next. They do not do the same: ansible writes the
files, reloads and checks that the files exist; meshctl also observes first, keeps the previous state under a dead-man's
switch, proves the node reachable with a new connection, checks its mesh, and confirms. The nodes run on the same
machine, so wall time includes them; CPU time is the tool's own.

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
from pathlib import Path
from typing import Any

from meshctl.errors import MeshctlError
from meshctl.render import DeviceFacts
from meshlab.fleet import VirtualFleet
from tests.meshctl.proof.rig import Rig

RESULTS = Path(__file__).with_name("results") / "provisioning.jsonl"
ANSIBLE = Path(sys.executable).with_name("ansible-playbook")
FORKS = 8
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


def by_meshctl(rig: Rig, variant: str) -> dict[str, float]:
    command = [sys.executable, "-m", "meshctl", "provision", "--yes", "--json", "-i", str(rig.inventory(variant))]
    return ran([*command, "--key", str(rig.directory / "key")], rig.environ, limit_s(rig))


def limit_s(rig: Rig) -> float:
    return LIMIT_S + LIMIT_PER_NODE_S * (rig.count + 1)


def by_ansible(rig: Rig, variant: str) -> dict[str, float]:
    """Push the same files with one script per node, as an operator would write it."""
    place = rig.directory / "ansible"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    hosts = {}
    for name in ("base", *rig.names):
        endpoint = rig.fleet.endpoint(_address(rig.fleet, name))
        files = rig.rendered(variant, name, DeviceFacts(""))
        (place / f"{name}.sh").write_text(script(files))
        hosts[name] = {
            "ansible_host": endpoint.host,
            "ansible_port": endpoint.port,
            "wireless_sha256": _sha256(files["etc/config/wireless"]),
        }
    (place / "hosts.json").write_text(json.dumps({"all": {"hosts": hosts}}))
    (place / "play.yaml").write_text(PLAYBOOK)
    environ = {
        **rig.environ,
        "ANSIBLE_HOST_KEY_CHECKING": "False",
        "ANSIBLE_PIPELINING": "True",
        "ANSIBLE_SSH_TRANSFER_METHOD": "piped",
        "ANSIBLE_SSH_USETTY": "False",
        "ANSIBLE_REMOTE_USER": "root",
        "ANSIBLE_PRIVATE_KEY_FILE": str(rig.directory / "key"),
        "ANSIBLE_SSH_ARGS": "-o ControlMaster=auto -o ControlPersist=30s -o UserKnownHostsFile=/dev/null",
        "ANSIBLE_HOME": str(place / "home"),
        "LC_ALL": "C.UTF-8",
    }
    command = [str(ANSIBLE), "-i", str(place / "hosts.json"), "--forks", str(FORKS), str(place / "play.yaml")]
    return ran(command, environ, limit_s(rig))


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


def measure(count: int) -> dict[str, Any]:
    """Run both tools on one fleet of `count` nodes and a base."""
    with tempfile.TemporaryDirectory(prefix="provisioning-") as directory, Rig(
        Path(directory), count - 1, window_s=60, parallel=FORKS
    ) as rig:  # fmt: skip
        taken = rig.take_in("a")
        if taken.code:
            raise RuntimeError(f"cannot bootstrap the fleet:\n{taken.out}{taken.err}")
        ours = by_meshctl(rig, "b")
        ansible = by_ansible(rig, "a")
        wrong = [name for name in ("base", *rig.names) if rig.state_of(name, "b", "a") != "new"]
        if wrong:
            raise RuntimeError(f"ansible did not change {', '.join(wrong)}")
    return {"nodes": count, "meshctl": ours, "ansible": ansible}


def table(results: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| nodes | tool | seconds | seconds per node | processor seconds per node |",
        "| --- | --- | --- | --- | --- |",
    ]
    for result in results:
        for tool in ("meshctl", "ansible"):
            took, nodes = result[tool], result["nodes"]
            lines.append(
                f"| {nodes} | {tool} | {took['seconds']:.1f} | {took['seconds'] / nodes:.2f} "
                f"| {took['cpu_s'] / nodes:.3f} |"
            )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.provisioning", description=__doc__)
    parser.add_argument("--nodes", default="10,50,200")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    arguments = parser.parse_args()
    if arguments.tables:
        print(table(recorded(arguments.results)))
        return 0
    if not ANSIBLE.exists():
        parser.error(f"{ANSIBLE} is not there: install the extra `bench` beside this interpreter")
    failed = 0
    for count in map(int, arguments.nodes.split(",")):
        try:
            result = measure(count)
        except (RuntimeError, MeshctlError, subprocess.TimeoutExpired) as error:
            failed += 1
            print(f"{count} nodes: {error}", file=sys.stderr, flush=True)
            continue
        arguments.results.parent.mkdir(parents=True, exist_ok=True)
        with arguments.results.open("a") as file:
            file.write(json.dumps(result) + "\n")
        print(table([result]), flush=True)
    print(table(recorded(arguments.results)))
    return 1 if failed else 0


def recorded(path: Path) -> list[dict[str, Any]]:
    """The latest result of each size."""
    lines = path.read_text().splitlines() if path.exists() else []
    return list({result["nodes"]: result for result in map(json.loads, lines)}.values())


if __name__ == "__main__":
    sys.exit(main())
