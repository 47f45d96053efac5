"""Robots and their computers, operators, fleet-wide settings, the transport and its topics."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.documents.base import NOT_WRITTEN, Document, SecretDocument
from meshctl.inventory.documents.node import PositionDocument, SshLayer
from meshctl.inventory.documents.thin import ThinLinkDocument, ThinPortsDocument
from meshctl.inventory.fields import Address, Flag, Interface, IPv4Only, Line, Name, Network, Real, Text, Whole, Window
from meshctl.model import Outbox, TopicClass


class ComputerLinkDocument(Document):
    """A further link of a robot's daemon, such as a second radio or a tether."""

    interface: Text = ""
    """Interface, or a pattern such as wlan*; or set `address`."""
    address: Address = NOT_WRITTEN
    """Address of the computer on that link, instead of its interface."""
    neighbors: dict[Name, Address] = Field(default_factory=dict)
    """Addresses of other robots there, by name, if no broadcast reaches them. Default: found by broadcast."""
    mtu: Whole = Field(default=NOT_WRITTEN, ge=576, le=65_535)
    """MTU in bytes, if the path carries less than the interface."""


class ComputerDocument(Document):
    """A robot's computer, where the udp_mesh daemon runs."""

    address: Interface
    """Address with prefix length."""
    ssh: SshLayer = Field(default_factory=SshLayer)
    """SSH login."""
    python: Text = "python3"
    """Python interpreter for the daemon."""
    arch: Text = "x86_64"
    """Architecture, as printed by `uname -m`."""
    ros: Text = ""
    """ROS distribution: noetic, humble..."""
    gateway: Address = NOT_WRITTEN
    """Its next hop to other networks: an address of one of the robot's radios. Default: that of the radio that routes
    the robot's LAN, else of the robot's first radio."""
    links: tuple[ComputerLinkDocument, ...] = ()
    """Links of the daemon beside the one with `address`, such as a second radio or a tether."""
    collector: Flag = False
    """Ask the robot's radios for their links, and add them to the daemon's conditions."""
    collector_key: Line = ""
    """The collector's SSH public key, which the robot's radios accept for that alone; written by `meshctl robots
    deploy`."""


class OtherComputerDocument(Document):
    """Another computer on the robot's switch, without a daemon."""

    address: Interface
    """Address with prefix length."""
    ssh: SshLayer = Field(default_factory=SshLayer)
    """SSH login, for `meshctl inventory export`."""


class LanDocument(Document):
    """A robot's LAN with a subnet of its own, routed by the robot's radios instead of bridged into the mesh."""

    network: Network
    """Subnet, such as 10.43.1.0/24."""
    addresses: dict[Name, Address] = Field(default_factory=dict)
    """Addresses of the robot's radios in it. Default: its first addresses, in the order of `nodes`."""


class RobotDocument(Document):
    """A robot or the operator's base station: a udp_mesh peer of this name."""

    nodes: tuple[Text, ...] = ()
    """Radios mounted on the robot; may contain ranges."""
    computer: ComputerDocument = NOT_WRITTEN
    """The robot's computer, where the udp_mesh daemon runs."""
    computers: dict[Name, OtherComputerDocument] = Field(default_factory=dict)
    """Other computers on its switch by name. The one that runs the daemon pings them for `meshctl status`."""
    is_base: Flag = False
    """True for the operator's base station."""
    carries: tuple[Text, ...] = ()
    """Beacons in the robot's racks; may contain ranges."""
    fielded: IPv4Only = NOT_WRITTEN
    """Address of the robot's computer while it runs the legacy udp_mesh; replace it with `computer` at migration."""
    lan: LanDocument = NOT_WRITTEN
    """Subnet of the robot's own LAN; its first radio in service routes it. Default: its radios bridge the mesh to its
    switch."""
    relay: tuple[Text, ...] = ()
    """Robots to and from which its daemon forwards datagrams; `all` for all."""
    position: PositionDocument = NOT_WRITTEN
    """Where it stands, if it does not move, as a base station."""
    thin: ThinPortsDocument = NOT_WRITTEN
    """Its number on thin links, and its serial ports for them."""


class OperatorsDocument(Document):
    """Who may log in to the radios."""

    ssh_keys: tuple[Text, ...] = ()
    """Public keys for root on every node."""
    password_login: Flag = False
    """Whether SSH accepts passwords; leave it off."""
    known_hosts: Text = "known_hosts"
    """File of pinned host keys; relative to this file. Default: beside the inventory's first file."""


class SystemDocument(Document):
    """OpenWrt system settings of all nodes."""

    timezone: Text = "UTC"
    """POSIX time zone, such as UTC or EST5EDT,M3.2.0,M11.1.0."""
    zonename: Text | None = None
    """Time zone name, such as America/New_York; default: UTC with `timezone: UTC`, otherwise none."""
    log_size_kib: Whole = Field(default=64, ge=8, le=65_536)
    """Size of the log in RAM."""
    log_host: Text = ""
    """Host that receives logs by UDP; empty for none."""
    log_port: Whole = Field(default=514, ge=1, le=65_535)
    """Port of the log host."""
    ntp_servers: tuple[Text, ...] = ()
    """Time servers; a mesh without internet needs its own."""


class ApplyDocument(Document):
    """How changes are rolled out to the fleet."""

    max_down: Whole = Field(default=1, ge=1, le=100_000)
    """Maximum number of nodes that may be down at the same time."""
    canary: Flag = True
    """Change and check one node first."""
    stop_after_failures: Whole = Field(default=1, ge=1, le=100_000)
    """Number of failures after which a run stops."""
    quorum: Real = Field(default=0.8, gt=0, le=1)
    """Share of the mesh that must rejoin after a change of the whole cell."""
    parallel: Whole | None = Field(default=None, ge=1, le=1024)
    """Maximum number of nodes in progress. Default: as many as their meshes and this machine can handle."""


class UdpMeshDocument(Document):
    """Transport settings of all robots."""

    port: Whole = Field(default=8700, ge=1, le=65_535)
    """UDP port."""
    keys: tuple[SecretDocument, ...] = ()
    """Live fleet keys: the first encrypts, all decrypt."""
    heartbeat_s: Real = Field(default=1.0, gt=0, le=3600)
    """Seconds between heartbeats."""
    offline_after_s: Real = Field(default=10.0, gt=0, le=86_400)
    """Seconds of silence after which a peer counts as offline."""
    fragment_bytes: Whole = Field(default=1400, ge=256, le=65_000)
    """Maximum fragment size of a message."""
    window: Window = None
    """Congestion window per peer in fragments: a number, or adaptive."""
    broadcast: Flag = True
    """Discover peers and reach all of them by broadcast."""
    metrics_port: Whole = Field(default=NOT_WRITTEN, ge=1, le=65_535)
    """TCP port of Prometheus metrics. Default: no metrics."""
    relay_hops: Whole = Field(default=4, ge=1, le=8)
    """Maximum number of links between two robots with relays between them; 1 turns relays off."""
    relay_keys: tuple[SecretDocument, ...] = ()
    """Keys of the hops of relays, as `keys`: with them, relays without a fleet key cannot read what they forward.
    Default: the fleet keys."""
    thin_links: dict[Name, ThinLinkDocument] = Field(default_factory=dict)
    """Thin links by name: slow radios on serial ports, for topics with `thin`."""
    thin_presence_s: Real = Field(default=45.0, ge=1, le=170)
    """Approximate interval of a robot's presence messages on thin links."""
    etc_hosts: Flag = False
    """Keep the peers' names in /etc/hosts of the robots' computers, for `ssh husky1`."""
    selective: Flag = True
    """Send robots only the topics that their programs read, no faster than requested."""


class TopicLogDocument(Document):
    """A shared log: every robot keeps the topic's items within these limits and passes them on."""

    max_items: Whole = Field(default=10_000, ge=1, le=16_000_000)
    """Maximum number of items on each robot."""
    max_bytes: Whole = Field(default=268_435_456, ge=1, le=1_000_000_000_000)
    """Maximum size of the items on each robot."""
    max_age_s: Real = Field(default=NOT_WRITTEN, ge=1, le=1_000_000_000)
    """Seconds after which a robot drops an item. Default: no limit."""
    copies: Whole = Field(default=3, ge=0, le=64)
    """How many robots that reach each other carry an item, besides its source and its destinations."""


class JpegDocument(Document):
    """How images are encoded."""

    quality: Whole = Field(default=60, ge=1, le=95)
    """JPEG quality."""
    min_quality: Whole = Field(default=10, ge=1, le=95)
    """The lowest quality with `adapt`."""
    scale: Real = Field(default=1.0, ge=0.01, le=1)
    """Factor for width and height."""


class ReductionDocument(Document):
    """What the ROS bridge sends of a topic instead of everything that is published."""

    rate_hz: Real = Field(default=NOT_WRITTEN, ge=0.001, le=1000)
    """Maximum number of messages per second; the others are dropped."""
    encode: JpegDocument = NOT_WRITTEN
    """Send images as JPEG, as sensor_msgs/CompressedImage. `{}` for the defaults."""
    voxel_m: Real = Field(default=NOT_WRITTEN, ge=0.001, le=100)
    """Send one point of a cloud per cube of this edge in meters."""
    max_voxel_m: Real = Field(default=NOT_WRITTEN, ge=0.001, le=100)
    """The largest edge with `adapt`."""
    fields: tuple[Text, ...] = ()
    """Fields of a cloud's points to keep, such as [x, y, z]. Default: all."""
    adapt: Flag = False
    """Lower the quality when messages take too long to arrive, and raise it again, within these bounds."""


class TopicDocument(Document):
    """A topic that udp_mesh carries."""

    priority: Whole = Field(ge=0, le=15)
    """0 is the most urgent, 15 the least."""
    topic_class: TopicClass = Field(default=TopicClass.OTHER, alias="class")
    """Purpose of the topic; lint checks its priority against it."""
    type_name: Text = Field(default="", alias="type")
    """Message type, such as std_msgs/Bool."""
    reliable: Flag = True
    """Reliable delivery instead of best effort."""
    sources: tuple[Text, ...] = ()
    """Robots that send the topic; empty for all."""
    destinations: tuple[Text, ...] = ("all",)
    """Robots that receive the topic; `all` for all."""
    rate_hz: Real = Field(default=0.0, ge=0, le=100_000)
    """Messages per second that one source publishes."""
    size_bytes: Whole = Field(default=0, ge=0, le=1_000_000_000)
    """Size of one message, as sent."""
    keep_last: Whole = Field(default=0, ge=0, le=1_000_000)
    """Number of queued messages to keep when the queue grows; 0 keeps all."""
    deadline_s: Real = Field(default=NOT_WRITTEN, gt=0, le=86_400)
    """Age in seconds after which a message is dropped."""
    rate_limit_bytes_per_s: Whole = Field(default=NOT_WRITTEN, ge=1, le=1_000_000_000)
    """Rate limit in bytes per second."""
    compression: Flag = False
    """Compress messages."""
    outbox: Outbox = Outbox.NONE
    """Messages kept for an offline peer: none, last or all."""
    outbox_bytes: Whole = Field(default=1_000_000, ge=0, le=1_000_000_000_000)
    """Maximum size of the outbox."""
    outbox_on_disk: Flag = False
    """Keep the outbox across restarts."""
    repair: Flag = False
    """Let receivers request lost broadcasts again."""
    delta: Flag = False
    """Send a message as the difference from the last one that its receiver has (maps, grids, images, states)."""
    delta_bytes: Whole = Field(default=16_777_216, ge=1, le=1_073_741_824)
    """Maximum size of a message to send as a difference; a larger one is sent whole."""
    always: Flag = False
    """Send the topic also to robots whose programs do not read it."""
    thin: Flag = False
    """Let thin links carry the topic, too: at once if it is urgent, else while a receiver has no other link."""
    thin_links: tuple[Text, ...] = ()
    """Thin links that carry it; empty for all."""
    thin_period_s: Real = Field(default=NOT_WRITTEN, gt=0, le=86_400)
    """Minimum seconds between two messages on thin links; the newest one is sent."""
    log: TopicLogDocument = NOT_WRITTEN
    """Make the topic a shared log, whose messages other robots also carry. `{}` for the defaults."""
    reduce: ReductionDocument = NOT_WRITTEN
    """Send fewer or smaller messages than are published; done by the ROS bridge."""
