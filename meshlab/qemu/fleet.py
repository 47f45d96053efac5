"""The Python face of a fleet of real radios: a virtual fleet whose supervisor is in a machine of its own."""

from __future__ import annotations

from meshlab.fleet import VirtualFleet
from meshlab.qemu.qemu import find_qemu


class QemuFleet(VirtualFleet):
    """`VirtualFleet` with the kernel's own radios, mesh and bridges.

    Files of nodes are in the machine: `VirtualNode.flash_path` and `console_log` have nothing on this side, `exec` and
    `console` read them.
    """

    SUPERVISOR = "meshlab.qemu.host_proxy"

    def _check_programs(self) -> None:
        find_qemu()
