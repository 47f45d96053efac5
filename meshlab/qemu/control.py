"""What else a fleet of real radios can be asked for, from the host: commands in its machine, radios' groups, losses.

All take the fleet's directory, as `VirtualFleet.attach` does, and act on the fleet that runs there at once. Links are
the fleet's truth: `VirtualFleet.link(a, b, up=..., loss=...)` sets groups and losses by itself, and survives nodes that
reboot. What is set here lasts until the next change of a link.

Every function raises LabError when no such fleet runs, InputError for nodes it does not have.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from meshctl.device.connection import Completed
from meshlab.client import request


def run(directory: Path, command: str, *, timeout_s: float = 60.0) -> Completed:
    """Run a shell command as root in the machine, outside of every node: iproute2, iw, batctl and busybox are there."""
    with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        descriptors = (source.fileno(), out.fileno(), err.fileno())
        answer = request(directory, {"op": "machine", "command": command}, descriptors, timeout_s=timeout_s)
        out.seek(0)
        err.seek(0)
        return Completed(out.read(), err.read(), int(answer["status"]))


def set_groups(directory: Path, masks: Mapping[str, int]) -> None:
    """Give each node's radios their hwsim group mask (64 bits, `radio_groups.assign`), in the mapping's order."""
    request(directory, {"op": "set_groups", "masks": dict(masks)})


def set_loss(directory: Path, losses: Mapping[tuple[str, str], float]) -> None:
    """Set what share (0..1) of the frames that the second node of each pair hears from the first is lost."""
    request(directory, {"op": "set_loss", "losses": [[a, b, loss] for (a, b), loss in losses.items()]})


def radios(directory: Path) -> dict[str, tuple[str, ...]]:
    """The kernel's names of each node's radios: `{"b01": ("phy1",)}`."""
    return {name: tuple(phys) for name, phys in request(directory, {"op": "radios"})["radios"].items()}
