"""Robots and their computers, operators, settings of the whole fleet, the transport and its topics."""

from __future__ import annotations

from pydantic import Field

from meshctl.inventory.documents.base import NOT_WRITTEN, Document, SecretDocument
from meshctl.inventory.documents.node import SshLayer
from meshctl.inventory.fields import Address, Flag, Interface, Real, Text, Whole, Window
from meshctl.model import Outbox, TopicClass


class ComputerDocument(Document):
    """A robot's computer, where the udp_mesh daemon runs."""

    address: Interface
    """Its address with the prefix length."""
    ssh: SshLayer = SshLayer()
    """How to log in."""
    python: Text = "python3"
    """The Python that runs the daemon."""
    arch: Text = "x86_64"
    """Its architecture as `uname -m` prints it."""
    ros: Text = ""
    """ROS distribution on it: noetic, humble..."""


class RobotDocument(Document):
    """A robot, or the operator's base station: the peer that udp_mesh knows by this name."""

    nodes: tuple[Text, ...] = ()
    """Radios mounted on it; ranges allowed."""
    computer: ComputerDocument = NOT_WRITTEN
    """Its computer."""
    is_base: Flag = False
    """True for the operator's base station."""
    carries: tuple[Text, ...] = ()
    """Beacons in its racks; ranges allowed."""
    fielded: Address = NOT_WRITTEN
    """Address of its computer while that still runs the fielded udp_mesh; `computer` takes its place later."""


class OperatorsDocument(Document):
    """Who may log in to the radios."""

    ssh_keys: tuple[Text, ...] = ()
    """Public keys for root on every node."""
    password_login: Flag = False
    """Whether SSH takes passwords; leave it off."""
    known_hosts: Text = "known_hosts"
    """File with the nodes' host keys for plain ssh; relative to the inventory."""


class SystemDocument(Document):
    """OpenWrt's system settings, the same on all nodes."""

    timezone: Text = "UTC"
    """POSIX time zone, such as UTC or EST5EDT,M3.2.0,M11.1.0."""
    zonename: Text = "UTC"
    """Its name, such as America/New_York."""
    log_size_kib: Whole = Field(default=64, ge=8, le=65_536)
    """Size of the log kept in RAM."""
    log_host: Text = ""
    """Where logs are sent by UDP; empty for nowhere."""
    log_port: Whole = Field(default=514, ge=1, le=65_535)
    """Port there."""
    ntp_servers: tuple[Text, ...] = ()
    """Time servers; a mesh without internet has its own or none."""


class ApplyDocument(Document):
    """How carefully a fleet is changed."""

    max_down: Whole = Field(default=1, ge=1, le=100_000)
    """Nodes that may be down for a change at the same time."""
    canary: Flag = True
    """Change one node first and look at it."""
    stop_after_failures: Whole = Field(default=1, ge=1, le=100_000)
    """Failures after which no further node is touched."""
    quorum: Real = Field(default=0.8, gt=0, le=1)
    """Share of the mesh that must be back after a change of the whole cell."""
    parallel: Whole = Field(default=8, ge=1, le=1024)
    """Connections open at the same time."""


class UdpMeshDocument(Document):
    """The transport's settings, the same on all robots."""

    port: Whole = Field(default=8700, ge=1, le=65_535)
    """UDP port."""
    keys: tuple[SecretDocument, ...] = ()
    """Live fleet keys: the first seals, all open."""
    heartbeat_s: Real = Field(default=1.0, gt=0, le=3600)
    """Seconds between signs of life."""
    offline_after_s: Real = Field(default=10.0, gt=0, le=86_400)
    """Seconds of silence after which a peer counts as offline."""
    fragment_bytes: Whole = Field(default=1400, ge=256, le=65_000)
    """Largest piece that a message is cut into."""
    window: Window = None
    """Fragments in flight to one peer: a number, or adaptive."""
    broadcast: Flag = True
    """Find peers and reach all of them by broadcast."""
    metrics_port: Whole = Field(default=NOT_WRITTEN, ge=1, le=65_535)
    """TCP port of Prometheus metrics; without it none."""


class TopicDocument(Document):
    """A topic that udp_mesh carries."""

    priority: Whole = Field(ge=0, le=15)
    """0 is the most urgent, 15 the least."""
    topic_class: TopicClass = Field(default=TopicClass.OTHER, alias="class")
    """What it is for; lint holds priorities against it."""
    type_name: Text = Field(default="", alias="type")
    """Message type, such as std_msgs/Bool."""
    reliable: Flag = True
    """Deliver or report, instead of best effort."""
    sources: tuple[Text, ...] = ()
    """Robots that send it; empty for every robot."""
    destinations: tuple[Text, ...] = ("all",)
    """Robots that get it; all for everyone."""
    rate_hz: Real = Field(default=0.0, ge=0, le=100_000)
    """Messages per second that one source offers."""
    size_bytes: Whole = Field(default=0, ge=0, le=1_000_000_000)
    """Size of one message."""
    keep_last: Whole = Field(default=0, ge=0, le=1_000_000)
    """Messages kept when they come faster than they leave; 0 keeps all."""
    deadline_s: Real = Field(default=NOT_WRITTEN, gt=0, le=86_400)
    """Age in seconds at which a message is dropped."""
    rate_limit_bytes_per_s: Whole = Field(default=NOT_WRITTEN, ge=1, le=1_000_000_000)
    """Most bytes per second that this topic may send."""
    compression: Flag = False
    """Compress messages."""
    outbox: Outbox = Outbox.NONE
    """What is kept for a peer that is offline: none, the last message, or all."""
    outbox_bytes: Whole = Field(default=1_000_000, ge=0, le=1_000_000_000_000)
    """Most bytes kept for it."""
    outbox_on_disk: Flag = False
    """Keep it across restarts."""
    repair: Flag = False
    """Send extra fragments against loss."""
