"""Radio interfaces that transmit although the node's configuration has turned them off.

25.12 leaves the interface of an open cell on the air when its radio is disabled or its section removed (wifi-scripts:
mac80211.sh, wdev.uc), until the radio is taken down or the node boots. A reload of `wireless` takes it down
(scripts/reload.sh).
"""

from __future__ import annotations

import re

from meshctl.device.observation import Observation
from meshctl.plan.cell import enabled_interfaces
from meshctl.plan.observed_files import WIRELESS, packages_seen
from meshctl.uci import Package

# names of mesh interfaces (`Node.mesh_interfaces`); other interfaces are not ours
_OURS = re.compile(r"mesh[0-9]+")
# modes as iw writes them
_MESH_MODES = ("IBSS", "mesh point")


def interface_names(wireless: Package | None) -> frozenset[str]:
    """The names of the enabled radio interfaces; empty for one without a name."""
    return frozenset(iface.get("ifname") for iface, _ in enabled_interfaces(wireless))


def left_over(observation: Observation) -> tuple[str, ...]:
    """The names of mesh interfaces that exist, but are not enabled in /etc/config/wireless; none if that is unreadable,
    or if it has an enabled interface without a name, which could be any."""
    wireless = packages_seen([WIRELESS], observation)["wireless"]
    if wireless is None:
        return ()
    named = interface_names(wireless)
    if "" in named:
        return ()
    return tuple(
        link.ifname
        for link in observation.links or ()
        if link.mode in _MESH_MODES and _OURS.fullmatch(link.ifname) and link.ifname not in named
    )
