"""A mesh: one radio cell and its routing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from meshctl.model.hardware import Band
from meshctl.model.ip import IpNetwork
from meshctl.model.secret import SecretRef


class MeshMode(Enum):
    """The link layer below the routing: an IBSS cell, or 802.11s without its own forwarding."""

    ADHOC = "adhoc"
    MESH = "mesh"


class Encryption(Enum):
    NONE = "none"
    PSK2 = "psk2+ccmp"
    SAE = "sae"


class Backend(Enum):
    BATMAN = "batman-adv"
    MESHMERIZE = "meshmerize"


@dataclass(frozen=True, slots=True)
class Batman:
    """batman-adv's options by their UCI names; `orig_interval_ms` None means derived from `Mesh.reconnect_s`.

    Defaults are the kernel's, except for the distributed ARP table (docs/decisions/0012-arp.md).
    """

    routing_algo: str = "BATMAN_IV"
    bridge_loop_avoidance: bool = True
    distributed_arp_table: bool = False
    aggregated_ogms: bool = True
    multicast_mode: bool = True
    fragmentation: bool = True
    hop_penalty: int = 30
    orig_interval_ms: int | None = None
    elp_interval_ms: int | None = None
    gw_mode: str = "off"


@dataclass(frozen=True, slots=True)
class OperatorParts:
    """Parts that the operator supplies for meshmerize, which has no public package or schema (openwrt-facts.md section
    8): templates, package files, the service's name, a command that prints its status."""

    templates: str = ""
    package_files: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    service: str = ""
    status_command: str = ""
    interface: str = ""
    base: str = ""


@dataclass(frozen=True, slots=True)
class Mesh:
    """`channel` and `htmode` as in UCI; `network` contains the nodes' management addresses; `mtu` is that of the hard
    interface (batman-adv needs 1500 + 32 bytes, and warns below 1500 + 60); `reconnect_s` is the target time to heal
    after a link fails."""

    name: str
    ssid: str
    bssid: str
    band: Band
    channel: int
    network: IpNetwork
    htmode: str = "HT20"
    mode: MeshMode = MeshMode.ADHOC
    encryption: Encryption = Encryption.NONE
    key: SecretRef | None = None
    mcast_rate_kbps: int = 12000
    distance_m: int = 1000
    beacon_interval_tu: int = 100
    mtu: int = 1560
    lan_mtu: int = 1500
    reconnect_s: float = 5.0
    min_beacons: int = 0
    backend: Backend = Backend.BATMAN
    batman: Batman = Batman()
    operator_parts: OperatorParts = OperatorParts()
