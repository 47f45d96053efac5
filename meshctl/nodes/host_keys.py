"""The nodes' host keys compared with the pinned ones, for `meshctl trust`."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass

from meshctl.device.errors import AuthenticationRefused
from meshctl.device.trust import AcceptAnyKey, HostKey, TrustStore
from meshctl.errors import NodeError
from meshctl.fleet import Outcome, Result, run
from meshctl.model import Node
from meshctl.nodes.connections import ConnectionPool


@dataclass(frozen=True, slots=True)
class HostKeyState:
    """A node's current host key; None, with `error`, when it does not answer. `pinned` are fingerprints."""

    node: Node
    key: HostKey | None
    pinned: tuple[str, ...] = ()
    error: str = ""

    @property
    def is_pinned(self) -> bool:
        return self.key is not None and self.key.fingerprint in self.pinned

    @property
    def is_changed(self) -> bool:
        return self.key is not None and bool(self.pinned) and not self.is_pinned

    @property
    def state(self) -> str:
        if self.key is None:
            return "unreachable"
        return "pinned" if self.is_pinned else "changed" if self.is_changed else "new"


def fetch_host_keys(
    connections: ConnectionPool, trust: TrustStore, nodes: Iterable[Node], *, parallel: int
) -> tuple[HostKeyState, ...]:
    """Fetch the host key of every node, trusting none."""
    by_name = {node.name: node for node in nodes}
    found: dict[str, HostKeyState] = {}
    lock = threading.Lock()

    def fetch_one(name: str) -> Outcome:
        node = by_name[name]
        host_key_policy = AcceptAnyKey()
        last_error = ""
        try:
            connections.open(node, policy=host_key_policy).close()
        except AuthenticationRefused:
            # the host key is known before the login is refused
            pass
        except NodeError as error:
            last_error = str(error)
        pinned = tuple(key.fingerprint for key in trust.pinned(name))
        with lock:
            found[name] = HostKeyState(node, host_key_policy.key, pinned, last_error)
        return Outcome(name, Result.DONE)

    run(by_name, fetch_one, parallel=parallel)
    return tuple(found[name] for name in by_name)
