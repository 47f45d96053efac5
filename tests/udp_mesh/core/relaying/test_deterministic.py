"""A simulation with relays is the same in every process, although the order of sets of bytes is not."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

from tests.udp_mesh.core.relaying.topologies import ring
from udp_mesh.core.interfaces import Datagram
from udp_mesh.sim.topology import Topology


class _Recorded(Topology):
    """Every datagram with its time, in one digest."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.digest = hashlib.sha256()

    def _transmit(self, name: str, datagram: Datagram) -> None:
        self.digest.update(f"{self.now} {name} {datagram.link} {datagram.destination} ".encode() + datagram.data)
        super()._transmit(name, datagram)


def played() -> str:
    topology = ring(loss=0.1, make=_Recorded)
    assert isinstance(topology, _Recorded)
    topology.run(4)
    for name in ("a", "d"):
        topology.send(name, "map", bytes(50_000))
    topology.run(8)
    return topology.digest.hexdigest()


def test_every_process_simulates_the_same() -> None:
    found = set()
    for seed in ("1", "4", "5", "6"):
        command = [sys.executable, "-c", f"from {__name__} import played; print(played())"]
        done = subprocess.run(
            command, env={**os.environ, "PYTHONHASHSEED": seed}, stdout=subprocess.PIPE, check=True, text=True
        )
        found.add(done.stdout)
    assert len(found) == 1
