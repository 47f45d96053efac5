"""`python -m tests.meshctl.proof.wires DIRECTORY`: two factory devices, each at 192.168.1.1 behind a cable of its own.

Runs in a network namespace of its own (`in_own_network` gives the command): a virtual fleet whose LAN ports are joined
to real interfaces w1 and w2 of that namespace, which meshctl gets by `--interface`. Prints the result as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.meshctl.proof.rig import Rig

WIRES = {"n001": "w1", "n002": "w2"}


def in_own_network(directory: Path, module: str = "wires") -> list[str]:
    """The command that runs a module where it may make interfaces, without touching the machine's own."""
    unshare = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--net", "--user", "--map-root-user"]
    return [*unshare, sys.executable, "-m", f"tests.meshctl.proof.{module}", str(directory)]


def main() -> int:
    """Plug both in, bootstrap them at once, and look whether each became the one it was said to be."""
    ip("link set lo up")
    with Rig(Path(sys.argv[1]), 2, knows_lab=False) as rig:
        rig.wait_all_up()
        plug_in(rig)
        words = [word for wire in WIRES.values() for word in ("--interface", wire)]
        taken = rig.meshctl("bootstrap", "a", *WIRES, *words, "--yes", "--json")
        route()
        again = rig.meshctl("provision", "a", *WIRES, "--check", "--json")
        report = {
            "results": taken.results,
            "names": {
                name: rig.fleet.node(name).exec("cat /proc/sys/kernel/hostname").stdout.strip() for name in WIRES
            },
            "addresses": {name: rig.fleet.node(name).address for name in WIRES},
            "error": taken.err,
            "out": taken.out,
            "check": again.code,
        }
    sys.stdout.write(json.dumps(report))
    return 0


def plug_in(rig: Rig) -> None:
    """Give each device its cable, and this end of it one address in the factory's network and one in the fleet's."""
    for number, (name, wire) in enumerate(WIRES.items(), 1):
        plug(rig, name, wire)
        for address in (f"192.168.1.{100 + number}/24", f"10.42.255.{number}/16"):
            ip(f"address add {address} dev {wire}")


def route() -> None:
    """After the bootstrap each has an address of its own, and the machine's routes say where."""
    for number, wire in enumerate(WIRES.values(), 1):
        ip(f"route add 10.42.1.{number} dev {wire} src 10.42.255.{number}")


def plug(rig: Rig, name: str, wire: str) -> None:
    """A cable between `wire` here and the node's bridge."""
    pid = next(node["pid"] for node in rig.fleet.status()["nodes"] if node["name"] == name)
    ip(f"link add {wire} type veth peer name plug netns {pid}")
    ip("link set plug master br-lan up", "nsenter", "-t", str(pid), "--net")
    ip(f"link set {wire} up")


def ip(words: str, *inside: str) -> None:
    subprocess.run([*inside, "ip", *words.split()], check=True)


if __name__ == "__main__":
    sys.exit(main())
