"""Whole teams in virtual time: the transport's core on a simulated radio channel.

scenario file -> `scenario.load` -> `run.play` (a `team.Team` of cores on a `medium.Medium`, driven by one
`event_queue.EventQueue`) -> summary, recording, report. `main` is `udp-mesh sim`; `sweep` runs many of them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str]) -> int:
    """`udp-mesh sim SCENARIO [--out DIR] [--json]` and `udp-mesh sim sweep`; returns the exit code."""
    if arguments and arguments[0] == "sweep":
        try:
            from udp_mesh.sim.sweep import run_sweep
        except ModuleNotFoundError as error:
            if not str(error.name).startswith("mesh_sweep"):
                raise
            # a robot's bundle has udp_mesh alone
            sys.stderr.write("udp-mesh: `sim sweep` needs the package mesh_sweep: install meshctl-fleet\n")
            return 2
        return run_sweep(arguments[1:])
    from udp_mesh.sim.command import run_command

    return run_command(arguments)
