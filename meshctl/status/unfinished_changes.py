"""Nodes that do not answer because of a change or a flash whose end no run has observed: what to wait for."""

from __future__ import annotations

from meshctl.apply.prepare import rollback_ends
from meshctl.fleet.journal import Journal
from meshctl.model import Fleet
from meshctl.report.duration import duration

# For so many times its limit a flash may go on: a slow one, or one whose run was interrupted.
FLASHES = 4


def waiting_hints(fleet: Fleet, journal: Journal, now_s: float) -> dict[str, str]:
    """Node -> the hint while it does not answer."""
    hints = {
        name: f"it may roll back a change: wait up to {duration(end_s - now_s)}, then run meshctl resume"
        for name, end_s in rollback_ends(fleet, journal).items()
        if end_s > now_s
    }
    for name, began_s in journal.latest_unfinished(fleet.name, "flash").items():
        node, age_s = fleet.nodes.get(name), now_s - began_s
        if node is not None and age_s < FLASHES * node.hardware.flash_timeout_s:
            began = f"its firmware may still be written (the flash began {duration(age_s)} ago)"
            hints[name] = f"leave it on: {began}; if it stays away, use its recovery recipe"
    return hints
