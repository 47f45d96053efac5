"""The state of one node at one moment: `Observation` and its parts, all frozen.

A fact is `None` if the node did not report it, or in a form the parsers do not know; `notes` has the reason. An empty
tuple or mapping means that the node reported none. Formats and sources: docs/facts/openwrt-facts.md, section 5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


@dataclass(frozen=True, slots=True)
class ReleaseInfo:
    """`ubus call system board` .release, or /etc/openwrt_release (DISTRIB_*)."""

    distribution: str
    version: str
    revision: str
    target: str
    description: str = ""


@dataclass(frozen=True, slots=True)
class BoardInfo:
    """`ubus call system board`, /tmp/sysinfo and /etc/board.json. `board_name` is `vendor,model`."""

    board_name: str
    model: str = ""
    hostname: str = ""
    kernel: str = ""
    # /etc/board.json .network.lan: `ports` or the single `device`/`ifname`
    lan_ports: tuple[str, ...] = ()
    label_mac: str = ""
    # .switch: (switch, VLAN, its ports as UCI has them) of switches that swconfig drives
    switch_vlans: tuple[tuple[str, str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Memory:
    """Bytes. `available` is the kernel's MemAvailable."""

    total: int
    free: int
    available: int


@dataclass(frozen=True, slots=True)
class Load:
    """/proc/loadavg: processes running or waiting, averaged over a minute; and the number of processors."""

    minute: float
    processors: int


@dataclass(frozen=True, slots=True)
class Space:
    """One file system, in bytes, from `df -k`."""

    path: str
    total: int
    free: int


@dataclass(frozen=True, slots=True)
class RadioState:
    """One radio of `ubus call network.wireless status`; `config` holds its options as text."""

    name: str
    up: bool
    pending: bool
    disabled: bool
    setup_failed: bool
    config: Mapping[str, str]
    interfaces: tuple[tuple[str, str], ...]
    """(UCI section, interface name) of each wifi-iface; the name is empty while it is down."""


@dataclass(frozen=True, slots=True)
class WirelessLink:
    """One interface of `iw dev`: the actual state of the radio, whatever its configuration."""

    ifname: str
    mode: str
    """`IBSS`, `mesh point`, `AP`, `managed`, ... as iw writes it."""
    mac: str = ""
    ssid: str | None = None
    bssid: str | None = None
    channel: int | None = None
    frequency_mhz: int | None = None
    width: str = ""
    tx_power_dbm: float | None = None
    joined: bool | None = None
    """Whether an IBSS (`iw dev IF link`) or a mesh point (`iw dev`) has joined; None for another mode."""
    phy: str = ""
    """The radio it runs on, as /sys/class/ieee80211 names it: `phy0`."""


@dataclass(frozen=True, slots=True)
class RadioChip:
    """The abilities of a radio, regardless of its configuration (`iw phy`, /sys/class/ieee80211)."""

    phy: str
    """By its number, as `WirelessLink.phy`: `phy0`."""
    path: str = ""
    """As UCI's `path` has it; empty if unknown."""
    driver: str = ""
    """As the kernel names it: `ath9k`, `ath10k_pci`."""
    modes: tuple[str, ...] = ()
    """As iw writes them: `IBSS`, `mesh point`, `AP`; empty if unknown."""
    frequencies_mhz: tuple[int, ...] = ()
    """Of all its channels, also those that the country forbids; empty if unknown."""


@dataclass(frozen=True, slots=True)
class Station:
    """One station entry of a radio (`iw dev IF station dump`)."""

    ifname: str
    mac: str
    signal_dbm: int | None = None
    inactive_ms: int | None = None
    tx_packets: int | None = None
    tx_retries: int | None = None
    tx_failed: int | None = None
    tx_mbit_s: float | None = None
    rx_mbit_s: float | None = None
    expected_mbit_s: float | None = None
    # the age of the entry
    connected_s: int | None = None
    signal_avg_dbm: int | None = None
    chain_signals_dbm: tuple[int, ...] = ()
    """Of the last frame, by receive chain."""
    tx_mcs: str = ""
    """As iw writes it: `MCS 15`, `VHT-MCS 8 NSS 2`; empty for a rate without one."""
    rx_mcs: str = ""
    mesh_link: str = ""
    """The state of the 802.11s peer link, such as `ESTAB` or `BLOCKED`; empty in other modes."""

    @property
    def can_forward(self) -> bool:
        """Whether frames pass: an 802.11s peer is heard, and refused, until its link is established."""
        return self.mesh_link in ("", "ESTAB")


@dataclass(frozen=True, slots=True)
class ChannelSurvey:
    """The channel in use, as a radio measures it (`iw dev IF survey dump`). The times are counted since the radio came
    up or changed its channel; `busy_ms` includes its own frames."""

    ifname: str
    frequency_mhz: int
    noise_dbm: int | None = None
    active_ms: int | None = None
    busy_ms: int | None = None


@dataclass(frozen=True, slots=True)
class Sensors:
    """Packets queued in mac80211 by radio (`phy0`), and temperatures in degrees Celsius by radio or thermal zone."""

    queued_packets: Mapping[str, int]
    temperatures_c: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class NetInterface:
    """One logical interface of `ubus call network.interface dump`."""

    name: str
    up: bool
    pending: bool
    device: str = ""
    addresses: tuple[str, ...] = ()
    """With prefix length, IPv4 first: `10.42.0.11/24`."""
    errors: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Bridge:
    """One bridge and its ports, from /sys/class/net."""

    name: str
    ports: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LanFilterCounts:
    """Frames of the wired ports that the LAN filter kept out of the mesh since the firewall was last loaded."""

    dropped_packets: int
    dropped_bytes: int


@dataclass(frozen=True, slots=True)
class MeshInfo:
    """`batctl meshif bat0 mesh_json`; on 19.07 the text commands."""

    version: str = ""
    algorithm: str = ""
    hard_interfaces: tuple[str, ...] | None = None
    """Of all batman-adv interfaces; None: not known."""
    settings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class MeshNeighbor:
    """One direct neighbor of batman-adv (`neighbors_json` or `batctl n`)."""

    mac: str
    ifname: str
    last_seen_ms: int


class Originator(NamedTuple):
    """One path of batman-adv (`originators_json` or `batctl o`): MACs in lower case, `tq` 0..255 (BATMAN_IV) or
    `throughput_kbit_s` (V).

    A tuple, because a fleet's tables have hundreds of thousands: it takes a third of a dataclass's time to make.
    """

    mac: str
    next_hop: str
    ifname: str
    last_seen_ms: int
    best: bool
    tq: int | None = None
    throughput_kbit_s: int | None = None


@dataclass(frozen=True, slots=True)
class MeshTableSizes:
    """Sizes of one batman-adv interface's tables; None: not known. Originators are counted by path, translations are
    those of the global table by the type of the client's address."""

    originators_selected: int | None = None
    originators_other: int | None = None
    tg_unicast: int | None = None
    tg_multicast: int | None = None


@dataclass(frozen=True, slots=True)
class HostKeyInfo:
    """A host key read on the node: `key_type` as in known_hosts, `fingerprint` `SHA256:...`."""

    key_type: str
    fingerprint: str


@dataclass(frozen=True, slots=True)
class FileInfo:
    """One file requested by path. `text` is None if it is not UTF-8; `sha256` is of its bytes."""

    path: str
    mode: int
    sha256: str
    text: str | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class ChangeStatus:
    """The state of the dead-man's switch (`deadman.sh status`); see docs/device-scripts.md for the states.

    `is_reloading_restored`: a rollback has ended, and its services still reload.
    """

    state: str
    change_id: str = ""
    owner: str = ""
    window_s: int | None = None
    left_s: float | None = None
    due_uptime_s: float | None = None
    reload_status: int | None = None
    lock_owner: str = ""
    lock_left_s: float | None = None
    last_id: str = ""
    last_outcome: str = ""
    last_reason: str = ""
    version: str = ""
    installed: bool = True
    is_reloading_restored: bool = False


@dataclass(frozen=True, slots=True)
class Observation:
    """All facts from one round trip. `asked_at_s` and `answered_at_s`: the observer's clock around it (Unix time)."""

    asked_at_s: float
    answered_at_s: float
    release: ReleaseInfo | None = None
    board: BoardInfo | None = None
    boot_id: str | None = None
    uptime_s: float | None = None
    clock_s: float | None = None
    load: Load | None = None
    memory: Memory | None = None
    overlay: Space | None = None
    is_first_boot: bool | None = None
    """Whether the first boot after a flash has not ended: see `openwrt.is_first_boot`."""
    root_read_only: bool | None = None
    """Whether / cannot be written: failsafe mode, or a failing flash."""
    tmp: Space | None = None
    macs: Mapping[str, str] | None = None
    """Interface name -> MAC address, from /sys/class/net."""
    ifindexes: Mapping[str, int] | None = None
    """Interface name -> the kernel's index; a recreated interface has a new one."""
    radios: tuple[RadioState, ...] | None = None
    links: tuple[WirelessLink, ...] | None = None
    chips: tuple[RadioChip, ...] | None = None
    stations: tuple[Station, ...] | None = None
    surveys: tuple[ChannelSurvey, ...] | None = None
    """One per interface whose driver reports one."""
    sensors: Sensors | None = None
    supplicants: tuple[str, ...] | None = None
    """The radio interfaces that wpa_supplicant runs; a mesh interface without it is unencrypted."""
    interfaces: tuple[NetInterface, ...] | None = None
    bridges: tuple[Bridge, ...] | None = None
    lan_filter: LanFilterCounts | None = None
    """None: the node has no LAN filter, or has not loaded it."""
    mesh: MeshInfo | None = None
    neighbors: tuple[MeshNeighbor, ...] | None = None
    originators: tuple[Originator, ...] | None = None
    """`observe_again` leaves out rows of a long table (near_originators in scripts/observe.sh)."""
    mesh_statistics: Mapping[str, Mapping[str, int]] | None = None
    """Interface of batman-adv -> its counters (`batctl statistics`)."""
    mesh_tables: Mapping[str, MeshTableSizes] | None = None
    """Interface of batman-adv -> the sizes of its tables."""
    package_tool: str | None = None
    packages: Mapping[str, str] | None = None
    """Installed package -> version."""
    uci: Mapping[str, str] | None = field(default=None, repr=False)
    """UCI package -> the text of /etc/config/PACKAGE; contains the keys of encrypted meshes."""
    uci_changes: tuple[str, ...] | None = None
    """Uncommitted changes (`uci changes`), one line each."""
    unconfirmed_packages: tuple[str, ...] | None = None
    """UCI packages that rpcd restores if LuCI does not confirm a change of them in time; None if it has no snapshot."""
    authorized_keys: tuple[str, ...] | None = None
    host_keys: tuple[HostKeyInfo, ...] | None = None
    files: Mapping[str, FileInfo | None] = field(default_factory=dict, repr=False)
    """The requested extra paths; None for a path that does not exist."""
    change: ChangeStatus | None = None
    notes: tuple[str, ...] = ()

    @property
    def clock_offset_s(self) -> float | None:
        """How far the node's clock is ahead of the observer's, at the middle of the round trip."""
        if self.clock_s is None:
            return None
        return self.clock_s - (self.asked_at_s + self.answered_at_s) / 2
