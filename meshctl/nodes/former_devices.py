"""The devices that `meshctl replace` has taken the place of, by their MACs.

The journal keeps them, since the inventory and the last known facts of a node are those of its new device.
"""

from __future__ import annotations

from collections.abc import Mapping

from meshctl.fleet.journal import LastKnown
from meshctl.model import Node
from meshctl.topology import with_alternates

# of the journal's keys for facts about the former devices of a node
FORMER_PREFIX = "former."
_MACS = "macs"


def facts_of_former_device(node: Node, known: Mapping[str, LastKnown]) -> tuple[str, dict[str, str]]:
    """The journal's key and facts for the device that is `node` now, and for those before it, once it is replaced."""
    key = f"{FORMER_PREFIX}{node.name}"
    seen = [word for name in (key, node.name) if name in known for word in known[name].facts.get(_MACS, "").split()]
    written = [mac for mac in (node.mac, *(radio.mac for radio in node.radios)) if mac]
    macs = dict.fromkeys(mac.lower() for mac in (*seen, *written))
    return key, {_MACS: " ".join(macs)} if macs else {}


def former_devices(known: Mapping[str, LastKnown]) -> dict[str, str]:
    """MAC -> the node that the device was."""
    return with_alternates(
        {
            mac: key.removeprefix(FORMER_PREFIX)
            for key, last in known.items()
            if key.startswith(FORMER_PREFIX)
            for mac in last.facts.get(_MACS, "").split()
        }
    )
