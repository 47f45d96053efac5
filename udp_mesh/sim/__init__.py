"""Whole teams in virtual time: the transport's core on a simulated radio channel.

scenario file -> `scenario.load` -> `run.play` (a `team.Team` of cores on a `medium.Medium`, driven by one
`event_queue.EventQueue`) -> summary, recording, report. `main` is `udp-mesh sim`.
"""

from __future__ import annotations

from collections.abc import Sequence


def main(arguments: Sequence[str]) -> int:
    """`udp-mesh sim SCENARIO [--out DIR] [--json]`; returns the exit code."""
    from udp_mesh.sim.command import run_command

    return run_command(arguments)
