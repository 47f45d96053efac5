"""Hardware profiles and meshes."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.documents.base import NOT_WRITTEN, Document, SecretDocument
from meshctl.inventory.fields import Flag, Mac, Name, Network, Port, Real, ReleaseName, SwitchPorts, Text, VlanId, Whole
from meshctl.model import AntennaKind, Backend, Band, Encryption, MeshMode


class RadioHardwareDocument(Document):
    """One radio of a board. Drive level, amplifier gain and antenna gain are separate values."""

    path: Text
    """The kernel's device path, as read from a device: `uci get wireless.radio0.path`."""
    band: Band
    """Frequency band."""
    rated_power_dbm: Real = Field(ge=-20, le=60)
    """Rated power in dBm: 30 for 1 W, 33 for 2 W."""
    max_drive_dbm: Whole = Field(ge=0, le=40)
    """Maximum transmit power of the driver in dBm."""
    amplifier_gain_db: Real = Field(default=0.0, ge=0, le=40)
    """Gain of an external amplifier, which the kernel does not account for."""
    antenna_gain_dbi: Real = Field(default=0.0, ge=-20, le=50)
    """Antenna gain."""
    cable_loss_db: Real = Field(default=0.0, ge=0, le=60)
    """Loss between the device and the antenna."""
    antenna: AntennaKind = AntennaKind.OMNI
    """Kind of antenna."""
    beamwidth_deg: Whole = Field(default=360, ge=1, le=360)
    """Horizontal beamwidth of the antenna in degrees."""
    chains: Whole = Field(default=2, ge=1, le=8)
    """Number of transmit chains."""
    driver: Text = Field(default="", pattern="^([a-z0-9]+(-[a-z0-9]+)*)?$")
    """Kernel module by its name in OpenWrt: ath9k, ath10k, ath10k-ct, mt76...; lint checks known limitations."""


class FirmwareDocument(Document):
    """An OpenWrt image and its expected properties."""

    image: Text = ""
    """Sysupgrade image; relative to this file."""
    sha256: Text = Field(default="", pattern="^([0-9a-fA-F]{64})?$")
    """SHA-256 of the image."""
    revision: Text = ""
    """OpenWrt revision of the image, such as r24106; a flashed node must report it."""
    usign_key: Text = ""
    """Public usign key that signed the checksums; relative to this file."""


class HardwareDocument(Document):
    """A hardware profile."""

    board: Text
    """The device's own name: `board_name` of `ubus call system board`, such as ubnt,rocket-m."""
    profile: Text
    """The ImageBuilder's profile name, such as ubnt_rocket-m."""
    target: Text
    """OpenWrt target, such as ath79/generic."""
    release: ReleaseName
    """OpenWrt release series."""
    radios: dict[Name, RadioHardwareDocument]
    """Radios by the names of their UCI sections."""
    lan_ports: tuple[Port, ...]
    """Ports bridged into the LAN, from `/etc/board.json`; `[]` for none."""
    switch_vlans: dict[VlanId, SwitchPorts] = Field(default_factory=dict)
    """VLANs of `switch0` and their ports, if swconfig drives it (ports such as eth0.1): `{1: "3 0t"}`."""
    memory_mib: Whole = Field(default=64, ge=8, le=1_048_576)
    """RAM in MiB."""
    flash_mib: Whole = Field(default=8, ge=4, le=1_048_576)
    """Flash in MiB."""
    firmware: FirmwareDocument = Field(default_factory=FirmwareDocument)
    """Firmware image of these devices."""
    packages: tuple[Text, ...] = ()
    """Packages in addition to those that the mesh needs."""
    package_files: tuple[Text, ...] = ()
    """Package files to install without internet; relative to this file."""
    confirm_window_s: Whole = Field(default=120, ge=10, le=3600)
    """Seconds that a node waits for confirmation of a change before it rolls back."""
    flash_timeout_s: Whole = Field(default=900, ge=300, le=14_400)
    """Seconds after which a flashed device that has not come back is reported as uncertain; more for a slow flash."""
    recovery: Text = ""
    """How to recover the device by hand; printed before it is flashed."""


class BatmanDocument(Document):
    """batman-adv's options by their UCI names."""

    routing_algo: Text = Field(default="BATMAN_IV", pattern="^(BATMAN_IV|BATMAN_V)$")
    """BATMAN_IV or BATMAN_V; must be the same on all nodes."""
    bridge_loop_avoidance: Flag = True
    """Prevents loops; required if two radios share a switch."""
    distributed_arp_table: Flag = False
    """Answer ARP from a distributed table: saves airtime in large meshes, but hides moved or replaced devices."""
    aggregated_ogms: Flag = True
    """Send several originator messages in one frame."""
    multicast_mode: Flag = True
    """Multicast optimization."""
    fragmentation: Flag = True
    """Fragment frames larger than the radio's MTU."""
    hop_penalty: Whole = Field(default=30, ge=0, le=255)
    """Penalty per hop."""
    orig_interval_ms: Whole = Field(default=NOT_WRITTEN, ge=40, le=60_000)
    """Milliseconds between originator messages. Default: derived from reconnect_s."""
    elp_interval_ms: Whole = Field(default=NOT_WRITTEN, ge=40, le=60_000)
    """Milliseconds between BATMAN_V's probes. Default: derived from reconnect_s."""
    gw_mode: Text = Field(default="off", pattern="^(off|client|server)$")
    """Gateway mode: off, client or server."""


class OperatorPartsDocument(Document):
    """Parts of a back end that the operator supplies because meshctl cannot ship them."""

    templates: Text = ""
    """Directory of templates; relative to this file."""
    package_files: tuple[Text, ...] = ()
    """Package files to install; relative to this file."""
    packages: tuple[Text, ...] = ()
    """Packages to install."""
    service: Text = ""
    """Name of the init script."""
    status_command: Text = ""
    """Command on the node that prints the back end's status."""
    interface: Text = ""
    """The back end's interface, to be bridged into the LAN."""


class MeshDocument(Document):
    """A mesh: one radio cell and its routing."""

    ssid: Text = Field(min_length=1)
    """SSID, or mesh ID in 802.11s mode; at most 32 bytes."""
    bssid: Mac = ""
    """Fixed BSSID for adhoc mode; must be locally administered and unicast, such as 02:..."""
    band: Band
    """Frequency band."""
    channel: Whole = Field(ge=1, le=196)
    """Channel number."""
    network: Network
    """Network of the management addresses."""
    htmode: Text = "HT20"
    """Channel width as UCI writes it: HT20, HT40, HT40+, VHT80..."""
    mode: MeshMode = MeshMode.ADHOC
    """adhoc (IBSS) or mesh (802.11s without its own forwarding)."""
    encryption: Encryption = Encryption.NONE
    """Encryption of the radio link."""
    key: SecretDocument = NOT_WRITTEN
    """Reference to the encryption key."""
    mcast_rate_kbps: Whole = Field(default=12000, ge=1000, le=54_000)
    """Multicast rate; a low one makes batman-adv prefer long weak links."""
    distance_m: Whole = Field(default=1000, ge=0, le=100_000)
    """Longest link in meters; sets the acknowledgment timeout."""
    beacon_interval_tu: Whole = Field(default=100, ge=15, le=65_535)
    """802.11 beacon interval in time units of 1024 us."""
    mtu: Whole = Field(default=1560, ge=68, le=9000)
    """MTU of the radio's interface: batman-adv needs 1532 for a full Ethernet frame, and logs a warning below 1560."""
    lan_mtu: Whole = Field(default=1500, ge=68, le=9000)
    """MTU of the LAN behind the nodes."""
    reconnect_s: Real = Field(default=5.0, gt=0, le=300)
    """Target time in seconds to heal after a link fails; selects batman-adv's intervals."""
    min_beacons: Whole = Field(default=0, ge=0, le=100_000)
    """Minimum number of beacons, checked by lint."""
    backend: Backend = Backend.BATMAN
    """Routing back end."""
    batman: BatmanDocument = Field(default_factory=BatmanDocument)
    """batman-adv's options."""
    operator_parts: OperatorPartsDocument = Field(default_factory=OperatorPartsDocument)
    """Parts that the operator supplies for meshmerize."""
