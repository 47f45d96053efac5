"""The status of radios, robots and the fleet: values for tables, JSON and the go/no-go checks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum

from meshctl.device.observation import LanFilterCounts, MeshTableSizes
from meshctl.errors import ExitCode
from meshctl.inventory.selection import COMPUTER
from meshctl.model import Node, NodeState, Robot
from meshctl.robots.facts import RobotFacts
from meshctl.topology import Sighting
from meshctl.wording import join_limited

_MAX_STRANGERS = 6


class Level(IntEnum):
    """Severity of an alarm: NOTE informs, WARNING degrades the device, ERROR makes it unfit for the mission."""

    NOTE = 0
    WARNING = 1
    ERROR = 2

    @property
    def text(self) -> str:
        return self.name.lower()


class Health(Enum):
    """State of a device. OFF: no answer and none required (carried, spare). UNREACHABLE: required, but no answer."""

    OK = "ok"
    DEGRADED = "degraded"
    UNREACHABLE = "unreachable"
    OFF = "off"

    @property
    def answers(self) -> bool:
        return self in (Health.OK, Health.DEGRADED)


@dataclass(frozen=True, slots=True)
class Alarm:
    """`code` is stable, for filters; `text` says what is wrong, `hint` what to do. `nodes`: those that an alarm of the
    fleet is about; none if it is about the fleet as a whole."""

    level: Level
    code: str
    text: str
    hint: str = ""
    nodes: tuple[str, ...] = ()


def health_of(alarms: Iterable[Alarm]) -> Health:
    """The health of a device that answers."""
    return Health.DEGRADED if any(alarm.level > Level.NOTE for alarm in alarms) else Health.OK


@dataclass(frozen=True, slots=True)
class NoAnswer:
    """Why a device gave no answer. `code` is `unreachable`, or why a device that is on could not be queried:
    `host-key`, `untrusted`, `login` or `failed`. `of_gateway`: the gateway of its site failed, so nothing is
    known about the device. `wait_for`: the hint for a device that is still being changed."""

    reason: str
    code: str = "unreachable"
    hint: str = ""
    of_gateway: bool = False
    wait_for: str = ""


@dataclass(frozen=True, slots=True)
class Neighbor:
    """A node heard directly. `quality` 0..1, None if not measured; `snr_db` is that of its frames here, `snr_there_db`
    that of ours at it. Rates and counters of frames to it (`tx`) and from it (`rx`); an MCS is empty if unused."""

    name: str
    age_ms: int
    quality: float | None
    signal_dbm: int | None
    mesh: str = ""
    noise_dbm: int | None = None
    snr_db: int | None = None
    snr_there_db: int | None = None
    chain_signals_dbm: tuple[int, ...] = ()
    tx_mcs: str = ""
    rx_mcs: str = ""
    tx_bitrate_kbit_s: int | None = None
    rx_bitrate_kbit_s: int | None = None
    expected_kbit_s: int | None = None
    tx_packets: int | None = None
    tx_retries: int | None = None
    tx_failed: int | None = None

    @property
    def worse_snr_db(self) -> int | None:
        """The lower of both directions, as far as they are known."""
        return min((snr for snr in (self.snr_db, self.snr_there_db) if snr is not None), default=None)


@dataclass(frozen=True, slots=True)
class RadioStatus:
    """One interface of a mesh. `busy_ratio` (0..1) is the share of time in which its channel was busy, its own frames
    included, over the last `busy_over_s`; `queue_packets` wait in the radio."""

    ifname: str
    mesh: str
    channel: int | None = None
    noise_dbm: int | None = None
    busy_ratio: float | None = None
    busy_over_s: float | None = None
    queue_packets: int | None = None
    temperature_c: float | None = None


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """The status of one radio. Unknown facts are None; `age_s` is the age of the facts, or of the last known facts if
    the node does not answer (None: never seen)."""

    node: Node
    health: Health
    alarms: tuple[Alarm, ...]
    age_s: float | None
    no_answer_reason: str = ""
    version: str = ""
    revision: str = ""
    drift: tuple[str, ...] | None = None
    uptime_s: float | None = None
    load: float | None = None
    """Load average over one minute, per processor."""
    processors: int | None = None
    memory_free: float | None = None
    """Share of available memory, 0..1."""
    flash_free_bytes: int | None = None
    clock_offset_s: float | None = None
    channels: tuple[int, ...] = ()
    tx_power_dbm: float | None = None
    lan_ports: tuple[str, ...] | None = None
    """Ports of its LAN bridge."""
    lan_filter: LanFilterCounts | None = None
    """None: it has no LAN filter, or has not loaded it."""
    radios: tuple[RadioStatus, ...] = ()
    temperature_c: float | None = None
    """Highest temperature that the board reports."""
    mesh_statistics: Mapping[str, Mapping[str, int]] | None = None
    """batman-adv's counters by its interface."""
    mesh_tables: Mapping[str, MeshTableSizes] | None = None
    """The sizes of batman-adv's tables by its interface."""
    neighbors: tuple[Neighbor, ...] = ()
    is_path_known: bool = True
    """Whether enough nodes were queried to know its path; then `hops` None means that there is none."""
    hops: int | None = None
    quality: float | None = None
    """Quality of the whole path to the base, 0..1."""
    via: str = ""
    is_cut_vertex: bool = False
    relays: tuple[str, ...] = ()
    """Nodes whose path to the base uses it."""
    heard_by: tuple[Sighting, ...] = ()
    last_known: Mapping[str, str] | None = None

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def title(self) -> str:
        return self.name

    @property
    def state(self) -> NodeState | None:
        return self.node.state

    @property
    def next_hop(self) -> Neighbor | None:
        """The neighbor on its path to the base, else the best one."""
        return next(
            (neighbor for neighbor in self.neighbors if neighbor.name == self.via),
            self.neighbors[0] if self.neighbors else None,
        )


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """One topic at one robot. `limit_s` is the longest gap that its rate and deadline allow (None: unlimited);
    `problem` says what is wrong, `code` in one word (`undeclared`, `silent`, `not-arriving`), both empty when nothing
    is."""

    name: str
    priority: int | None
    sent_ago_s: float | None
    received_ago_s: float | None
    limit_s: float | None = None
    problem: str = ""
    code: str = ""


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """The status of one robot's computer and its udp_mesh daemon; `facts` is None if it did not answer.

    `state` is that of its radios: DEPLOYED when one of them is, None for a robot without any. `heard_by` are the robots
    whose daemons hear this one's. `base_round_trip_s` is its daemon's to the base's.
    """

    robot: Robot
    state: NodeState | None
    health: Health
    alarms: tuple[Alarm, ...]
    age_s: float | None
    no_answer_reason: str = ""
    facts: RobotFacts | None = None
    topics: tuple[TopicStatus, ...] = ()
    is_compared: bool = True
    """Whether its configuration could be compared with the inventory."""
    urgent_bytes: int = 0
    """Queued bytes at the priorities of emergency stops and commands."""
    base_round_trip_s: float | None = None
    heard_by: tuple[Sighting, ...] = ()
    last_known: Mapping[str, str] | None = None

    @property
    def name(self) -> str:
        return self.robot.name

    @property
    def title(self) -> str:
        """`rover1 computer`: a radio may have the robot's name."""
        return f"{self.name} {COMPUTER}"


@dataclass(frozen=True, slots=True)
class FleetStatus:
    """Every managed radio and every robot with a computer, at `taken_s` (Unix time), collected in `took_s` seconds.

    `strangers` are MACs heard in the mesh that belong to no node of the inventory; `alarms` concern the whole fleet.
    """

    fleet: str
    taken_s: float
    entry: str
    nodes: tuple[NodeStatus, ...]
    robots: tuple[RobotStatus, ...] = ()
    strangers: tuple[str, ...] = ()
    alarms: tuple[Alarm, ...] = ()
    took_s: float = 0.0

    def __iter__(self) -> Iterator[NodeStatus | RobotStatus]:
        """Radios in the inventory's order, each robot's computer after the last of its radios."""
        last = {node.node.robot: node.name for node in self.nodes if node.node.robot}
        by_name = {robot.name: robot for robot in self.robots}
        for node in self.nodes:
            yield node
            robot = node.node.robot
            if last.get(robot) == node.name and robot in by_name:
                yield by_name.pop(robot)
        yield from by_name.values()

    def count(self, health: Health) -> int:
        """The number of radios and robots with this health."""
        return sum(device.health is health for device in self)

    @property
    def exit_code(self) -> ExitCode:
        """0 healthy, 1 degraded, 3 a required device is unreachable."""
        if self.count(Health.UNREACHABLE):
            return ExitCode.UNREACHABLE
        is_fleet_degraded = any(alarm.level > Level.NOTE for alarm in self.alarms)
        return ExitCode.FINDINGS if self.count(Health.DEGRADED) or self.strangers or is_fleet_degraded else ExitCode.OK


def stranger_alarm(status: FleetStatus) -> Alarm:
    """The alarm of the strangers in the mesh."""
    are = "are" if len(status.strangers) > 1 else "is"
    text = f"{join_limited(status.strangers, _MAX_STRANGERS)} {are} in the mesh but not in the inventory"
    return Alarm(Level.WARNING, "stranger", text, "if it is yours, add its `mac:` to the inventory")
