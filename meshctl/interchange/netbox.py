"""Devices of NetBox -> rows of the import. Pure: the records are its REST API's, as JSON.

Name, asset tag, serial number, primary address and MAC address are NetBox's to say; a state only of a new node, because
meshctl tracks it from then on. Role and hardware profile are taken over where the inventory has one of that name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from meshctl.inventory.csv_table import NODE, Row
from meshctl.model import Fleet, NodeState, Role

Record = Mapping[str, Any]

# NetBox's device statuses (dcim/choices.py, DeviceStatusChoices).
STATES: Mapping[str, NodeState] = {
    "active": NodeState.DEPLOYED,
    "planned": NodeState.SPARE,
    "staged": NodeState.SPARE,
    "inventory": NodeState.SPARE,
    "offline": NodeState.SPARE,
    "failed": NodeState.LOST,
    "decommissioning": NodeState.RETIRED,
}


def rows(devices: Iterable[Record], interfaces: Iterable[Record], fleet: Fleet) -> tuple[Row, ...]:
    """One row per device with a name, `line` its id in NetBox; `interfaces` are those of these devices."""
    macs = _macs(interfaces)
    found = []
    for device in devices:
        name, number = device.get("name") or "", int(device["id"])
        if name:
            values = {NODE: name, **_values(device, macs.get(number, ""), fleet)}
            found.append(Row(number, {key: value for key, value in values.items() if value}))
    return tuple(found)


def _values(device: Record, mac: str, fleet: Fleet) -> dict[str, str]:
    values = {
        "label": device.get("asset_tag") or "",
        "serial": device.get("serial") or "",
        "mac": mac.lower(),
        "address": _text(device.get("primary_ip"), "address").partition("/")[0],
        # NetBox before 3.6 called it device_role
        "role": _role(_text(device.get("role") or device.get("device_role"), "slug")),
        "hardware": _hardware(device.get("device_type"), fleet),
    }
    if device.get("name") not in fleet.nodes:
        state = STATES.get(_text(device.get("status"), "value"))
        values["state"] = "" if state is None else state.value
    return values


def _text(record: object, key: str) -> str:
    """A text of a nested record, empty if either is missing."""
    value = record.get(key) if isinstance(record, Mapping) else None
    return value if isinstance(value, str) else ""


def _role(slug: str) -> str:
    return slug if slug in {role.value for role in Role} else ""


def _hardware(device_type: object, fleet: Fleet) -> str:
    """The profile whose name, ImageBuilder name or board is the device type's slug or model."""
    words = {_text(device_type, "slug"), _text(device_type, "model")} - {""}
    for profile in fleet.hardware.values():
        if words & {profile.name, profile.profile, profile.board}:
            return profile.name
    return ""


def _macs(interfaces: Iterable[Record]) -> dict[int, str]:
    """Device -> the MAC address of its first interface that has one, by name; management interfaces come last."""
    found: dict[int, str] = {}
    for interface in sorted(interfaces, key=lambda each: (bool(each.get("mgmt_only")), str(each.get("name")))):
        device = interface.get("device")
        mac = interface.get("mac_address")
        if isinstance(device, Mapping) and isinstance(mac, str) and mac:
            found.setdefault(int(device["id"]), mac)
    return found
