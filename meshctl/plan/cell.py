"""The cell of a radio, read from UCI: everything radios must share to be in the same mesh.

wireless + network packages -> `cells` -> one `Cell` per radio; `differences` lists the fields that differ.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields

from meshctl.uci import Package, Section

# batman-adv's default without the option (openwrt-facts.md section 1)
DEFAULT_ROUTING = "BATMAN_IV"

# the difference of a radio that is in no cell any more
LEAVES_MESH = "leaves the mesh"


@dataclass(frozen=True, slots=True)
class Cell:
    """Everything that must be equal on both ends; `key` is only compared, never shown."""

    mode: str
    channel: str
    htmode: str
    ssid: str
    bssid: str
    encryption: str
    key: str
    routing_algo: str

    def __repr__(self) -> str:
        return f"Cell({self.mode}, {self.ssid!r}, channel {self.channel}, {self.htmode})"


def cells(wireless: Package | None, network: Package | None) -> dict[str, Cell]:
    """Radio section -> its configured cell. A radio that is disabled, or not in a mesh mode, has none."""
    return {
        device.name: _cell(device, iface, _routing_algo(network, iface.get("network")))
        for iface, device in enabled_interfaces(wireless)
        if device.name is not None and iface.get("mode") in ("adhoc", "mesh")
    }


def enabled_interfaces(wireless: Package | None) -> Iterator[tuple[Section, Section]]:
    """Each wifi-iface that is enabled, with its wifi-device, which is enabled, too."""
    if wireless is None:
        return
    devices = {section.name: section for section in wireless.of_type("wifi-device")}
    for iface in wireless.of_type("wifi-iface"):
        device = devices.get(iface.get("device"))
        if device is not None and "1" not in (device.get("disabled", "0"), iface.get("disabled", "0")):
            yield iface, device


def _cell(device: Section, iface: Section, routing: str) -> Cell:
    encryption = iface.get("encryption", "none")
    return Cell(
        mode=iface.get("mode"),
        channel=device.get("channel"),
        htmode=device.get("htmode"),
        ssid=iface.get("mesh_id") or iface.get("ssid"),
        bssid=iface.get("bssid").lower(),
        encryption=encryption,
        key="" if encryption == "none" else iface.get("key"),
        routing_algo=routing,
    )


def _routing_algo(network: Package | None, interface: str) -> str:
    """The algorithm of the batman-adv interface that this hard interface belongs to; empty with another back end."""
    hard = None if network is None else network.section(interface)
    if network is None or hard is None or hard.get("proto") != "batadv_hardif":
        return ""
    master = network.section(hard.get("master"))
    return DEFAULT_ROUTING if master is None else master.get("routing_algo", DEFAULT_ROUTING)


def differences(before: Cell, after: Cell) -> tuple[str, ...]:
    """`channel 6 -> 11`, one for each field that differs; a key is not shown."""
    changed = []
    for item in fields(Cell):
        old, new = getattr(before, item.name), getattr(after, item.name)
        if old != new:
            changed.append(
                f"{item.name} changes" if item.name == "key" else f"{item.name} {old or '-'} -> {new or '-'}"
            )
    return tuple(changed)


def partitions(before: Mapping[str, Cell], after: Mapping[str, Cell]) -> dict[str, tuple[str, ...]]:
    """Radio -> how its current cell differs from the planned one; a radio without a current cell is left out."""
    return {
        radio: changed
        for radio, cell in before.items()
        if (changed := differences(cell, after[radio]) if radio in after else (LEAVES_MESH,))
    }
