"""A fleet of many virtual nodes, some of which fail in ways that have to be distinguished."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from tests.meshctl.proof.rig import Ended, Rig

# What is done to a node, and which results are right for it.
RIGHT: Mapping[str, tuple[str, ...]] = {
    "off": ("unreachable",),
    "ssh-hang": ("unreachable",),
    "host-key": ("refused",),
    "foreign-delta": ("refused",),
    "wrong-board": ("refused",),
    "full-flash": ("refused", "failed"),
    "power-cut@reload_config": ("rolled back",),
    "power-cut@mv -f /etc/meshctl/change": ("done", "rolled back"),
    "sever@reload_config": ("uncertain", "rolled back"),
    "power-cut@gzip -t": ("done", "failed", "unreachable"),
}


def hurt_and_provision(rig: Rig, *, share: float, old: str, new: str) -> dict[str, Any]:
    """Hurt `share` of the nodes, each in the next way of `RIGHT`; provision; repair; resume. Returns the result."""
    count = max(len(RIGHT), round(len(rig.names) * share)) if share else 0
    hurt = dict(zip(rig.names[:: max(1, len(rig.names) // max(1, count))], list(RIGHT) * count, strict=False))
    hurt = dict(list(hurt.items())[:count])
    for name, what in hurt.items():
        rig.fleet.inject_fault(name, what)
    began = time.monotonic()
    first = rig.meshctl("provision", new, "--yes", "--json")
    took_s = time.monotonic() - began
    wrong = _wrong(rig, hurt, first)
    rig.fleet.repair()
    rig.wait_all_up()
    keys = [name for name, what in hurt.items() if what == "host-key"]
    if keys:
        rig.meshctl("trust", new, *keys, "--replace", "--yes")
    again = rig.meshctl("resume", new, "--yes", "--json")
    states = {name: rig.state_of(name, old, new) for name in ("base", *rig.names)}
    return {
        "nodes": len(rig.names) + 1,
        "hurt": len(hurt),
        "seconds": round(took_s, 1),
        "results": _counted(first),
        "wrong": wrong,
        "resumed": _counted(again),
        "not new": {name: state for name, state in states.items() if state != "new"},
    }


def _wrong(rig: Rig, hurt: Mapping[str, str], ended: Ended) -> dict[str, str]:
    """Nodes whose result is not one that is right for what was done to them; no result at all is wrong, too."""
    wrong = {}
    for name in ("base", *rig.names):
        result = ended.results.get(name, "none")
        if result not in (RIGHT[hurt[name]] if name in hurt else ("done",)):
            wrong[name] = f"{hurt.get(name, 'nothing done to it')}: {result}"
    return wrong


def _counted(ended: Ended) -> dict[str, int]:
    results = list(ended.results.values())
    return {result: results.count(result) for result in sorted(set(results))}
