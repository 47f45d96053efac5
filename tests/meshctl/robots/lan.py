"""A network of its own for robots and their operator: a bridge in a namespace, one cable to each machine.

Nothing of the network of the machine the tests run on is touched. A test stands inside (`Lan.inside`), as the operator
at `OPERATOR`.
"""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from meshlab.namespaces import CLONE_NEWNET, setns, unshare
from tests.meshctl.device.servers import PATIENCE_S

OPERATOR = "10.42.0.250"
# Of a cable's two ends: the longest name the kernel takes is 15 characters.
_CABLE = "cable{number}"


class Lan:
    """The bridge. `plug_in` gives a new machine's namespace a cable; `close` takes it all down."""

    def __init__(self, operator: str = OPERATOR) -> None:
        self._namespaces: list[int] = []
        self._own = _path(self._keep(_new_namespace()))
        self._cables = 0
        self._run("ip", "link", "set", "lo", "up")
        self._run("ip", "link", "add", "lan", "type", "bridge")
        self._run("ip", "addr", "add", f"{operator}/24", "brd", "+", "dev", "lan")
        self._run("ip", "link", "set", "lan", "up")

    def plug_in(self, address: str) -> str:
        """A new network namespace with this address on its `eth0`; the path to enter it by."""
        there = _path(self._keep(_new_namespace()))
        self._run("ip", "link", "set", "lo", "up", at=there)
        self.connect(there, address, "eth0")
        return there

    def connect(self, there: str, address: str, interface: str) -> None:
        """One more cable, to a namespace that has others."""
        self._cables += 1
        cable = _CABLE.format(number=self._cables)
        self._run("ip", "link", "add", cable, "type", "veth", "peer", "name", interface, "netns", there)
        self._run("ip", "link", "set", cable, "master", "lan", "up")
        self._run("ip", "addr", "add", f"{address}/24", "brd", "+", "dev", interface, at=there)
        self._run("ip", "link", "set", interface, "up", at=there)

    def inside(self) -> AbstractContextManager[None]:
        """This thread, and the threads and processes it starts, are in the network."""
        return in_network(self._own)

    def close(self) -> None:
        while self._namespaces:
            os.close(self._namespaces.pop())

    def _keep(self, namespace: int) -> int:
        self._namespaces.append(namespace)
        return namespace

    def _run(self, *words: str, at: str = "") -> None:
        subprocess.run(["nsenter", f"--net={at or self._own}", *words], check=True, timeout=PATIENCE_S)


@contextmanager
def in_network(path: str) -> Iterator[None]:
    """This thread, and the threads and processes it starts, are in the network namespace that `path` enters."""
    outside, inside = os.open("/proc/thread-self/ns/net", os.O_RDONLY), os.open(path, os.O_RDONLY)
    try:
        setns(inside, CLONE_NEWNET)
        yield
    finally:
        setns(outside, CLONE_NEWNET)
        os.close(outside)
        os.close(inside)


def _new_namespace() -> int:
    """An open descriptor keeps it alive. Made by a thread that ends, since a thread cannot be in two."""
    made: list[int] = []

    def make() -> None:
        unshare(CLONE_NEWNET)
        made.append(os.open("/proc/thread-self/ns/net", os.O_RDONLY))

    thread = threading.Thread(target=make)
    thread.start()
    thread.join()
    return made[0]


def _path(namespace: int) -> str:
    return f"/proc/{os.getpid()}/fd/{namespace}"
