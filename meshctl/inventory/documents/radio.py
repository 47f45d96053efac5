"""Hardware profiles and meshes: what a box is, and the cell that radios share."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.documents.base import NOT_WRITTEN, Document, SecretDocument
from meshctl.inventory.fields import Flag, Mac, Name, Network, Real, ReleaseName, SwitchPorts, Text, VlanId, Whole
from meshctl.model import AntennaKind, Backend, Band, Encryption, MeshMode


class RadioHardwareDocument(Document):
    """One radio of a board; what the driver drives, what an amplifier adds and what leaves are separate numbers."""

    path: Text
    """The kernel's device path, read off a device: `uci get wireless.radio0.path`."""
    band: Band
    """The band it works in."""
    rated_power_dbm: Real = Field(ge=-20, le=60)
    """Power the box is sold as: 30 for 1 W, 33 for 2 W."""
    max_drive_dbm: Whole = Field(ge=0, le=40)
    """Highest transmit power that the driver offers."""
    amplifier_gain_db: Real = Field(default=0.0, ge=0, le=40)
    """What an amplifier behind the chip adds; the kernel knows nothing of it."""
    antenna_gain_dbi: Real = Field(default=0.0, ge=-20, le=50)
    """Gain of the antenna."""
    cable_loss_db: Real = Field(default=0.0, ge=0, le=60)
    """What is lost between the box and the antenna."""
    antenna: AntennaKind = AntennaKind.OMNI
    """Kind of antenna."""
    beamwidth_deg: Whole = Field(default=360, ge=1, le=360)
    """Horizontal width of its beam in degrees."""
    chains: Whole = Field(default=2, ge=1, le=8)
    """Number of antennas that send at once."""
    driver: Text = Field(default="", pattern="^([a-z0-9]+(-[a-z0-9]+)*)?$")
    """Kernel module by its name in OpenWrt: ath9k, ath10k, ath10k-ct, mt76...; lint knows what some cannot do."""


class FirmwareDocument(Document):
    """An OpenWrt image and what it must be."""

    image: Text = ""
    """The sysupgrade image; relative to the file that names it."""
    sha256: Text = Field(default="", pattern="^([0-9a-fA-F]{64})?$")
    """Its SHA-256."""
    revision: Text = ""
    """OpenWrt's revision in it, such as r24106; a flashed node must report it."""
    usign_key: Text = ""
    """Public usign key that signed the list of checksums; relative to the file that names it."""


class HardwareDocument(Document):
    """What a box of one kind is."""

    board: Text
    """What the device calls itself: `board_name` of `ubus call system board`, such as ubnt,rocket-m."""
    profile: Text
    """The ImageBuilder's name for it, such as ubnt_rocket-m."""
    target: Text
    """OpenWrt's target, such as ath79/generic."""
    release: ReleaseName
    """OpenWrt's release series."""
    radios: dict[Name, RadioHardwareDocument]
    """Its radios by the names of their UCI sections."""
    lan_ports: tuple[Text, ...]
    """Ports that are bridged into the LAN, from `/etc/board.json`; `[]` for none."""
    switch_vlans: dict[VlanId, SwitchPorts] = Field(default_factory=dict)
    """VLANs of `switch0` where swconfig drives it (ports such as eth0.1), with their ports: `{1: "3 0t"}`."""
    memory_mib: Whole = Field(default=64, ge=8, le=1_048_576)
    """RAM in MiB."""
    flash_mib: Whole = Field(default=8, ge=4, le=1_048_576)
    """Flash in MiB."""
    firmware: FirmwareDocument = FirmwareDocument()
    """The image that these boxes run."""
    packages: tuple[Text, ...] = ()
    """Packages beyond the ones meshctl needs."""
    package_files: tuple[Text, ...] = ()
    """Package files to install without internet; relative to the inventory."""
    confirm_window_s: Whole = Field(default=120, ge=10, le=3600)
    """How long a node waits for the confirmation of a change before it goes back."""
    recovery: Text = ""
    """How to revive the box by hand; printed before it is flashed."""


class BatmanDocument(Document):
    """batman-adv's options by their UCI names."""

    routing_algo: Text = Field(default="BATMAN_IV", pattern="^(BATMAN_IV|BATMAN_V)$")
    """BATMAN_IV or BATMAN_V; the same on all nodes."""
    bridge_loop_avoidance: Flag = True
    """Needed where two radios share a switch."""
    distributed_arp_table: Flag = False
    """Answer ARP from a table spread over the mesh: less airtime among many, but it hides who moved or was replaced."""
    aggregated_ogms: Flag = True
    """Send several originator messages in one frame."""
    multicast_mode: Flag = True
    """Optimize multicast."""
    fragmentation: Flag = True
    """Split frames that are larger than the radio's MTU."""
    hop_penalty: Whole = Field(default=30, ge=0, le=255)
    """What each hop costs in link quality."""
    orig_interval_ms: Whole = Field(default=NOT_WRITTEN, ge=40, le=60_000)
    """Milliseconds between originator messages; without it chosen from reconnect_s."""
    elp_interval_ms: Whole = Field(default=NOT_WRITTEN, ge=40, le=60_000)
    """Milliseconds between BATMAN_V's probes; without it chosen from reconnect_s."""
    gw_mode: Text = Field(default="off", pattern="^(off|client|server)$")
    """Gateway mode: off, client or server."""


class OperatorPartsDocument(Document):
    """What the operator supplies for a back end that meshctl cannot ship."""

    templates: Text = ""
    """Directory of templates; relative to the file that names it."""
    package_files: tuple[Text, ...] = ()
    """Package files to install; relative to the file that names them."""
    packages: tuple[Text, ...] = ()
    """Packages to install."""
    service: Text = ""
    """Name of the init script."""
    status_command: Text = ""
    """Command on the node that prints the back end's status."""
    interface: Text = ""
    """The interface it makes, to be bridged into the LAN."""


class MeshDocument(Document):
    """A mesh: one radio cell and the routing above it, the same for all its radios."""

    ssid: Text = Field(min_length=1)
    """Name of the cell, at most 32 bytes."""
    bssid: Mac = ""
    """Fixed cell id for adhoc mode, locally administered and unicast: starts with 02."""
    band: Band
    """Its band."""
    channel: Whole = Field(ge=1, le=196)
    """Its channel."""
    network: Network
    """The network that holds all management addresses."""
    htmode: Text = "HT20"
    """Channel width as UCI writes it: HT20, HT40, HT40+, VHT80..."""
    mode: MeshMode = MeshMode.ADHOC
    """adhoc (IBSS) or mesh (802.11s without its own forwarding)."""
    encryption: Encryption = Encryption.NONE
    """Encryption of the radio link."""
    key: SecretDocument = NOT_WRITTEN
    """Where the key of the encryption is."""
    mcast_rate_kbps: Whole = Field(default=12000, ge=1000, le=54_000)
    """Rate of broadcasts; a low one makes batman-adv prefer long weak links."""
    distance_m: Whole = Field(default=1000, ge=0, le=100_000)
    """Longest link in metres; sets the acknowledgement timeout."""
    beacon_interval_tu: Whole = Field(default=100, ge=15, le=65_535)
    """Interval of 802.11 beacons in time units of 1024 us."""
    mtu: Whole = Field(default=1560, ge=68, le=9000)
    """MTU of the radio's interface: batman-adv needs 1532 for a full Ethernet frame, and logs a warning below 1560."""
    lan_mtu: Whole = Field(default=1500, ge=68, le=9000)
    """MTU of the LAN behind the nodes."""
    reconnect_s: Real = Field(default=5.0, gt=0, le=60)
    """Wanted seconds to heal after a link is cut; chooses batman-adv's intervals."""
    min_beacons: Whole = Field(default=0, ge=0, le=100_000)
    """Fewest beacons this mesh should have; lint reports fewer."""
    backend: Backend = Backend.BATMAN
    """What routes."""
    batman: BatmanDocument = BatmanDocument()
    """batman-adv's options."""
    operator_parts: OperatorPartsDocument = OperatorPartsDocument()
    """What the operator supplies for meshmerize."""
