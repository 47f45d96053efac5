"""How many processes and syncs a virtual node has had: the kernel numbers a node's processes in sequence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from benchmarks.model_node.node import Cost
from meshlab.fleet import VirtualNode


def counted(node: VirtualNode) -> Cost:
    """How many processes and syncs the node has had."""
    said = node.exec("read -r _ _ _ _ last </proc/loadavg; echo $last; cat /tmp/lab/syncs 2>/dev/null || echo 0").stdout
    processes, syncs = map(int, said.split())
    return Cost(processes, syncs)


@contextmanager
def counting(node: VirtualNode, kind: str, costs: dict[str, Cost]) -> Iterator[None]:
    """Record what the block needs on the node; looking at the counters is not counted."""
    idle = counted(node)
    before = counted(node)
    yield
    after = counted(node)
    costs[kind] = Cost(
        after.processes - before.processes - (before.processes - idle.processes), after.syncs - before.syncs
    )
