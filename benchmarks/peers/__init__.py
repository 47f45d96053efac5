"""The compared transports behind one interface.

A `Sender` sends two kinds of message to one receiver: `bulk` (returns when the transport accepts more, so that a
sender's queue is bounded) and `urgent`. A receiver calls `on_message` with each message. Every message starts with the
header of `benchmarks.peers.message`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Protocol

PORT = 7447


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
