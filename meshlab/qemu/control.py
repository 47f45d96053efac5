"""Low-level access to a QEMU fleet from the host: run commands in its machine, set radios' groups.

All functions take the fleet's directory, as `VirtualFleet.attach` does. Prefer `VirtualFleet.link`, which sets the
groups itself and survives reboots; what is set here lasts until the next change of a link.

Every function raises LabError when no such fleet runs, InputError for unknown nodes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from meshctl.device.connection import Completed
from meshlab.client import MACHINE_ANSWER_S, request


def run(directory: Path, command: str, *, timeout_s: float = MACHINE_ANSWER_S) -> Completed:
    """Run a shell command as root in the machine, outside every node, with iproute2, iw, batctl and busybox."""
    with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        descriptors = (source.fileno(), out.fileno(), err.fileno())
        answer = request(directory, {"op": "machine", "command": command}, descriptors, timeout_s=timeout_s)
        out.seek(0)
        err.seek(0)
        return Completed(out.read(), err.read(), int(answer["status"]))


def set_groups(directory: Path, masks: Mapping[str, int]) -> None:
    """Set the hwsim group mask (64 bits, `hwsim_groups.assign`) of each node's radios, in the mapping's order."""
    request(directory, {"op": "set_groups", "masks": dict(masks)})


def radios(directory: Path) -> dict[str, tuple[str, ...]]:
    """The phy names of each node's radios: `{"b01": ("phy1",)}`."""
    return {name: tuple(phys) for name, phys in request(directory, {"op": "radios"})["radios"].items()}
