"""The operator's side of many sites: `python -m benchmarks.sites [--sizes 1x10,4x10,10x10] [--results FILE]
[--tables] [--fill]`.

Model nodes (`benchmarks.model_node`: a real dropbear each, at a router's pace) in one mesh per site, changed by
`meshctl provision` through real workers on a real OpenSSH server, all on this machine. Every uplink is cut at random, a
few times while the sites change, for one to five seconds. Measured is the operator's process alone: processor time and
peak memory. A run counts only if every node ends as `done`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.model_node.fleet import INVENTORY, VARIANTS, ModelFleet
from benchmarks.page import append_result, fill, read_results, this_machine
from tests.meshctl.device.servers import openssh, public
from tests.meshctl.sites.forwarder import CuttableUplink
from tests.meshctl.sites.wheels import required_wheels

RESULTS = Path(__file__).with_name("results") / "sites.jsonl"
LIMIT_S = 1800.0
SEED = 1
# how long an uplink is there, and away
_UP_S, _DOWN_S = (20.0, 60.0), (1.0, 5.0)
# all sites share two cores here: a change may take many times as long as at a site of its own
_WINDOW_S = 600
# nodes in work at a site
_PARALLEL = 2


class SiteFleet(ModelFleet):
    """Model nodes in the order of their sites; the site of `name` is that of its number."""

    def __init__(self, directory: Path, sites: int, nodes: int, uplinks: Mapping[str, CuttableUplink]) -> None:
        self.sites = tuple(f"site{number:02}" for number in range(1, sites + 1))
        self._per_site = nodes
        self._uplinks = uplinks
        super().__init__(directory, sites * nodes)

    def _write_inventories(self, parallel: int | None) -> None:
        super()._write_inventories(parallel)
        head, _, _ = INVENTORY.partition("meshes:")
        head = head.replace("confirm_window_s: 60", f"confirm_window_s: {_WINDOW_S}")
        for number, variant in enumerate(VARIANTS):
            policy = f", parallel: {_PARALLEL}"
            text = head.format(
                key=f"{self._public} benchmark", log_size=64 + number, policy=policy, distance=0, penalty=0
            )
            text += "meshes:\n"
            for site in self.sites:
                # the cell that model nodes report
                text += (
                    f'  {site}: {{ssid: proof, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, '
                    f"network: 10.42.0.0/16, distance_m: {1000 + number}}}\n"
                )
            text += "sites:\n"
            for site in self.sites:
                port = self._uplinks[site].port
                text += f'  {site}: {{ssh: {{host: 127.0.0.1, port: {port}, user: root, key_files: ["{self.key}"]}}}}\n'
            text += "defaults: {hardware: box, state: deployed, role: beacon}\nnodes:\n"
            for index, (name, port) in enumerate(self.ports.items()):
                site = self.sites[index // self._per_site]
                address = f"10.42.{1 + (index + 1) // 250}.{1 + (index + 1) % 250}"
                text += (
                    f"  {name}: {{address: {address}, site: {site}, radios: {{radio0: {{mesh: {site}}}}}, "
                    f"ssh: {{host: 127.0.0.1, port: {port}}}}}\n"
                )
            self.inventory(variant).write_text(text, encoding="utf-8")


@contextmanager
def _gateway(directory: Path, sites: int) -> Iterator[tuple[Path, dict[str, CuttableUplink], Path]]:
    """A gateway for all sites, and an uplink to it for each."""
    login = directory / "login"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(login)], check=True)
    place = directory / "gateway"
    with ExitStack() as stack:
        server = stack.enter_context(
            openssh(place, public(login), "MaxStartups 1000", "MaxSessions 1000", host_key_type="ed25519")
        )
        names = [f"site{number:02}" for number in range(1, sites + 1)]
        uplinks = {name: stack.enter_context(CuttableUplink(server.port)) for name in names}
        yield place, uplinks, login


def measure(sites: int, nodes: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="sites-") as scratch:
        directory = Path(scratch)
        with _gateway(directory, sites) as (place, uplinks, login):
            (directory / "fleet").mkdir()
            fleet = SiteFleet(directory / "fleet", sites, nodes, uplinks)
            _let_in(fleet, place, login, uplinks)
            with fleet.running():
                taken = _provision(fleet, uplinks)
    return {"sites": sites, "nodes": nodes, **taken, **this_machine()}


def _let_in(fleet: SiteFleet, place: Path, login: Path, uplinks: Mapping[str, CuttableUplink]) -> None:
    """Give the operator's key a login at the gateway, each site a worker's key, and the operator the host key."""
    shutil.copy(fleet.key, login)
    shown = subprocess.run(["ssh-keygen", "-y", "-f", str(fleet.key)], capture_output=True, text=True, check=True)
    public(login).write_text(shown.stdout)
    pins = (fleet.directory / "known_hosts").read_text()
    host_key = " ".join((place / "host_key.pub").read_text().split()[:2])
    for site in uplinks:
        pins += f"site.{site} {host_key}\n"
        there = place / "root/.local/state/meshctl/sites/model" / site
        there.mkdir(parents=True, mode=0o700)
        shutil.copy(fleet.key, there / "id_ed25519")
        (there / "id_ed25519.pub").write_text(shown.stdout)
        (there / "operators").write_text(shown.stdout)
    (fleet.directory / "known_hosts").write_text(pins)
    _install(fleet)


def _install(fleet: SiteFleet) -> None:
    """Install meshctl on the gateway, for all sites there."""
    wheels = required_wheels(fleet.directory / "wheels")
    # the command writes the worker's key into its inventory
    scratch = fleet.directory / "install.yaml"
    shutil.copy(fleet.inventory("a"), scratch)
    command = [sys.executable, "-m", "meshctl", "sites", "install", fleet.sites[0], "--wheels", str(wheels)]
    done = subprocess.run(
        [*command, "-i", str(scratch)], env=fleet.environ, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"cannot install the worker:\n{done.stdout}{done.stderr}")


def _provision(fleet: SiteFleet, uplinks: Mapping[str, CuttableUplink]) -> dict[str, Any]:
    """Change all nodes from `a` to `b` while uplinks are cut; what the operator's process used."""
    command = [sys.executable, "-m", "meshctl", "provision", "--yes", "--json", "-i", str(fleet.inventory("b"))]
    done = threading.Event()
    cuts: list[int] = []
    began = time.monotonic()
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, env=fleet.environ, stdin=subprocess.DEVNULL, stdout=output, stderr=errors)
        limit = threading.Timer(LIMIT_S, process.kill)
        limit.start()
        cutter = threading.Thread(target=_cut_at_random, args=(uplinks, done, cuts), daemon=True)
        cutter.start()
        _, status, used = os.wait4(process.pid, 0)
        limit.cancel()
        done.set()
        cutter.join()
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        errors.seek(0)
        said, failed = output.read().decode(), errors.read().decode()
    last = json.loads(said.splitlines()[-1]) if said else {}
    results = {item["node"]: item["result"] for item in last.get("outcomes", ())}
    if process.returncode or set(results.values()) != {"done"} or len(results) != len(fleet.names):
        counted = {result: list(results.values()).count(result) for result in set(results.values())}
        reasons = {item["reason"] for item in last.get("outcomes", ()) if item["result"] != "done"}
        raise RuntimeError(f"ended with {process.returncode}, {counted}: {sorted(reasons)[:3]}\n{failed[-3000:]}")
    return {
        "seconds": round(time.monotonic() - began, 1),
        "cpu_s": round(used.ru_utime + used.ru_stime, 2),
        "memory_mib": round(used.ru_maxrss / 1024, 1),
        "cuts": len(cuts),
    }


def _cut_at_random(uplinks: Mapping[str, CuttableUplink], done: threading.Event, cuts: list[int]) -> None:
    """Cut each uplink once it has been used, and again and again."""
    rng = random.Random(SEED)
    next_s = dict.fromkeys(uplinks, 0.0)
    is_up = dict.fromkeys(uplinks, True)
    while not done.wait(0.1):
        now = time.monotonic()
        for name, uplink in uplinks.items():
            if uplink.accepted == 0:
                continue
            if not next_s[name]:
                next_s[name] = now + rng.uniform(*_UP_S)
            elif now >= next_s[name]:
                is_up[name] = not is_up[name]
                if is_up[name]:
                    uplink.mend()
                else:
                    uplink.cut()
                    cuts.append(1)
                next_s[name] = now + rng.uniform(*(_UP_S if is_up[name] else _DOWN_S))


def table(results: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| sites | nodes each | seconds | cuts of uplinks | operator's processor seconds | per site | peak memory |",
        "| ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for each in results:
        lines.append(
            f"| {each['sites']} | {each['nodes']} | {each['seconds']:.0f} | {each['cuts']} | {each['cpu_s']:.1f} "
            f"| {each['cpu_s'] / each['sites']:.2f} | {each['memory_mib']:.0f} MiB |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sites", description=__doc__)
    parser.add_argument("--sizes", default="1x10,4x10,10x10", help="SITESxNODES, comma-separated")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--tables", action="store_true", help="only print the table of existing results")
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    if not arguments.tables:
        for size in filter(None, arguments.sizes.split(",")):
            sites, nodes = map(int, size.split("x"))
            result = measure(sites, nodes)
            append_result(arguments.results, result)
            print(table([result]), flush=True)
    latest = {(result["sites"], result["nodes"]): result for result in read_results(arguments.results)}
    text = table([latest[key] for key in sorted(latest)])
    print(text)
    if arguments.fill:
        fill("sites", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
