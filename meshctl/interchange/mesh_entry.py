"""A device's mesh interface -> an entry of `meshes`. Pure."""

from __future__ import annotations

from collections.abc import Mapping

from meshctl.interchange.device import ExistingDevice
from meshctl.interchange.wireless import ExistingRadio, encryption, integer, is_meshmerize, mesh_id
from meshctl.inventory.documents import BatmanDocument, MeshDocument
from meshctl.inventory.yaml_text import Value
from meshctl.model import Backend, Encryption, Secret
from meshctl.model.ip import IpNetwork
from meshctl.uci import Package, Section

_BATMAN_FLAGS = ("bridge_loop_avoidance", "distributed_arp_table", "aggregated_ogms", "multicast_mode", "fragmentation")
# The kernel's values, which an option that is not set leaves.
_KERNEL_FLAGS: Mapping[str, str] = dict.fromkeys(_BATMAN_FLAGS, "1")
_KERNEL_ORIG_INTERVAL_MS = 1000
_FLAGS = {"1": True, "0": False}
ASSUMED_CHANNEL = {"2g": 1, "5g": 36}
_BRIDGE_MTU = "1500"


def mesh_entry(
    device: ExistingDevice, radio: ExistingRadio, network: IpNetwork, port: str
) -> tuple[dict[str, Value], Secret | None, list[str]]:
    """The entry without its key, the key, and what had to be assumed. `port` is meshmerize's interface in the bridge.
    Values that are the inventory's defaults are left out."""
    interface = radio.interface
    assert interface is not None, "only radios with a mesh interface"
    assumed: list[str] = []
    link = device.link(interface)
    entry: dict[str, Value] = {"ssid": mesh_id(interface)}
    bssid = interface.get("bssid").lower()
    if interface.get("mode") == "adhoc" and not bssid and link is not None and link.bssid:
        bssid = link.bssid.lower()
        assumed.append(f"bssid: {bssid}, the cell's current one, because none is configured")
    if bssid:
        entry["bssid"] = bssid
    entry["band"] = radio.band.value
    entry["channel"] = _channel(radio, None if link is None else link.channel, assumed)
    entry["network"] = str(network)
    options: dict[str, Value] = {
        "htmode": radio.section.get("htmode") or "HT20",
        "mode": interface.get("mode"),
        "encryption": encryption(interface).value,
        "backend": (Backend.MESHMERIZE if is_meshmerize(device, radio) else Backend.BATMAN).value,
    }
    for key, text in (
        ("mcast_rate_kbps", interface.get("mcast_rate")),
        ("distance_m", radio.section.get("distance")),
        ("beacon_interval_tu", radio.section.get("beacon_int")),
        ("mtu", "" if radio.hardif is None else radio.hardif.get("mtu")),
        ("lan_mtu", _lan_mtu(device.package("network"), radio)),
    ):
        number = integer(text)
        if number is not None:
            options[key] = number
    entry.update({key: value for key, value in options.items() if not _is_default(key, value)})
    if radio.batman is not None:
        batman = _batman(radio.batman, radio.hardif)
        if batman:
            entry["batman"] = batman
    if is_meshmerize(device, radio):
        assumed.append("operator_parts: meshmerize's templates, packages and service are to be added")
        if port:
            entry["operator_parts"] = {"interface": port}
    key = interface.get("key")
    if not key and encryption(interface) is not Encryption.NONE:
        key = interface.get("sae_password")
    is_secret = encryption(interface) is not Encryption.NONE and key
    return entry, Secret(key) if is_secret else None, assumed


def _is_default(key: str, value: Value) -> bool:
    default = MeshDocument.model_fields[key].default
    return bool(value == getattr(default, "value", default))


def _channel(radio: ExistingRadio, current: int | None, assumed: list[str]) -> int:
    written = integer(radio.section.get("channel"))
    if written:
        return written
    channel = current or ASSUMED_CHANNEL[radio.band.value]
    source = "the cell's current one" if current else "because the device chooses it by itself"
    assumed.append(f"channel: {channel}, {source}")
    return channel


def _lan_mtu(network: Package, radio: ExistingRadio) -> str:
    """The MTU of the bridge, or of a router's interface, that has batman-adv's interface as its device."""
    if radio.batman is None:
        return ""
    name = radio.batman.name or ""
    for section in network.sections:
        members = {*section.get("ports").split(), *section.get("ifname").split(), section.get("name")}
        if section.type in ("device", "interface") and name in members and not section.get("proto").startswith("bat"):
            return section.get("mtu") or _BRIDGE_MTU
    return ""


def _batman(section: Section, hardif: Section | None) -> dict[str, Value]:
    """batman-adv's options where they differ from the inventory's defaults."""
    found: dict[str, Value] = {}
    for name in _BATMAN_FLAGS:
        flag = _FLAGS.get(section.get(name, _KERNEL_FLAGS[name]), True)
        if flag is not BatmanDocument.model_fields[name].default:
            found[name] = flag
    for name in ("routing_algo", "gw_mode"):
        if section.get(name) and section.get(name) != BatmanDocument.model_fields[name].default:
            found[name] = section.get(name)
    penalty = integer(section.get("hop_penalty"))
    if penalty is not None and penalty != BatmanDocument.model_fields["hop_penalty"].default:
        found["hop_penalty"] = penalty
    interval = integer(section.get("orig_interval"))
    if interval is not None and interval != _KERNEL_ORIG_INTERVAL_MS:
        found["orig_interval_ms"] = interval
    elp = integer("" if hardif is None else hardif.get("elp_interval"))
    if elp is not None:
        found["elp_interval_ms"] = elp
    return found
