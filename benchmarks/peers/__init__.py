"""The compared transports behind one interface.

A `Sender` sends two kinds of message to one receiver: `bulk` (returns when the transport accepts more, so that a
sender's queue is bounded) and `urgent`. A receiver calls `on_message` with each message. Every message starts with the
header of `benchmarks.peers.message`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

PORT = 7447
_HERE = Path(__file__).parent
ROS2_PYTHON = _HERE.parents[1] / ".venv-ros2" / "bin" / "python"
"""The interpreter that scripts/setup-ros2 makes: its wheels exist for one version of Python."""


class Sender(Protocol):
    """An open connection to the receiver."""

    async def bulk(self, data: bytes) -> None: ...

    async def urgent(self, data: bytes) -> None: ...


class Transport(Protocol):
    """The interface of each module of this package, for one variant of a transport."""

    def sender(self, address: str) -> AbstractAsyncContextManager[Sender]: ...

    def receiver(self, on_message: Callable[[bytes], None]) -> AbstractAsyncContextManager[None]: ...


@dataclass(frozen=True, slots=True)
class Peer:
    """`variant` is the argument of the module's `transport(variant)`."""

    name: str
    module: str
    variant: str
    # set on every TCP socket of a program that cannot configure it
    congestion_control: str = ""
    # the interpreter of both ends; None: the one that runs the benchmark
    python: Path | None = None
    environment: Mapping[str, str] = field(default_factory=dict)


def _fast_dds(kind: str, profiles: str, variant: str, congestion_control: str = "") -> Peer:
    """ROS 2 with the settings of an XML file beside this one."""
    environment = {
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "RMW_FASTRTPS_USE_QOS_FROM_XML": "1",
        "FASTDDS_DEFAULT_PROFILES_FILE": str(_HERE / profiles),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    }
    name = f"ROS 2 Fast DDS ({kind})"
    return Peer(name, "benchmarks.peers.fast_dds", variant, congestion_control, ROS2_PYTHON, environment)


def _cyclone_dds() -> Peer:
    environment = {"CYCLONEDDS_URI": f"file://{_HERE / 'cyclone_dds.xml'}"}
    return Peer("Cyclone DDS", "benchmarks.peers.cyclone_dds", "reliable", "", ROS2_PYTHON, environment)


PEERS: dict[str, Peer] = {
    peer.name: peer
    for peer in (
        Peer("udp_mesh", "benchmarks.peers.ours", "adaptive"),
        Peer("udp_mesh, window 3", "benchmarks.peers.ours", "3"),
        Peer("TCP cubic", "benchmarks.peers.tcp", "cubic"),
        Peer("TCP BBR", "benchmarks.peers.tcp", "bbr"),
        Peer("QUIC (aioquic, cubic)", "benchmarks.peers.quic", "cubic"),
        Peer("Zenoh (TCP cubic)", "benchmarks.peers.zenoh_tcp", "priorities", "cubic"),
        Peer("Zenoh (TCP BBR)", "benchmarks.peers.zenoh_tcp", "priorities", "bbr"),
        _fast_dds("UDP", "fast_dds_udp.xml", "one node"),
        _fast_dds("TCP cubic", "fast_dds_tcp.xml", "two nodes", "cubic"),
        _fast_dds("TCP BBR", "fast_dds_tcp.xml", "two nodes", "bbr"),
        _cyclone_dds(),
        Peer("nimbro_network's wire (UDP, FEC 0.25)", "benchmarks.peers.nimbro", "fec 0.25"),
        Peer("nimbro_network's wire (UDP, FEC 0.5)", "benchmarks.peers.nimbro", "fec 0.5"),
        Peer("nimbro_network's wire (bulk TCP BBR)", "benchmarks.peers.nimbro", "tcp", "bbr"),
        Peer("Pound's wire", "benchmarks.peers.pound", "1240"),
    )
}


def peer_called(name: str) -> Peer:
    """A peer by its name in the tables; `udp_mesh, window N` has a fixed number of packets in flight."""
    ours, _, window = name.partition(", window ")
    return PEERS[name] if name in PEERS else Peer(name, PEERS[ours].module, window)


def transport(name: str) -> Transport:
    """The transport of a peer by its name in the tables."""
    peer = peer_called(name)
    made: Transport = importlib.import_module(peer.module).transport(peer.variant)
    return made
