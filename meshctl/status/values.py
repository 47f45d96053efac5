"""What is known of each radio, of each robot and of the fleet: values for tables, scripts and the go/no-go."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum

from meshctl.errors import ExitCode
from meshctl.model import Node, NodeState, Robot
from meshctl.robots.facts import RobotFacts
from meshctl.topology import Sighting


class Level(IntEnum):
    """How much an alarm matters: NOTE informs, WARNING degrades what it is about, ERROR makes it unfit for the run."""

    NOTE = 0
    WARNING = 1
    ERROR = 2

    @property
    def text(self) -> str:
        return self.name.lower()


class Health(Enum):
    """One word per device. OFF: silent, and expected to be (carried, spare). UNREACHABLE: silent, and missed."""

    OK = "ok"
    DEGRADED = "degraded"
    UNREACHABLE = "unreachable"
    OFF = "off"

    @property
    def answers(self) -> bool:
        return self in (Health.OK, Health.DEGRADED)


@dataclass(frozen=True, slots=True)
class Alarm:
    """`code` is stable, for filters; `text` one sentence for a person, `hint` what to do about it."""

    level: Level
    code: str
    text: str
    hint: str = ""


def health_of(alarms: Iterable[Alarm]) -> Health:
    """Of somebody who answers."""
    return Health.DEGRADED if any(alarm.level > Level.NOTE for alarm in alarms) else Health.OK


@dataclass(frozen=True, slots=True)
class NoAnswer:
    """Why somebody gave no answer. `code`: `unreachable` for silence, else what kept us out of a device that is there
    (`host-key`, `untrusted`, `login`, `failed`)."""

    reason: str
    code: str = "unreachable"
    hint: str = ""


@dataclass(frozen=True, slots=True)
class Neighbor:
    """A node heard directly. `quality` 0..1, None where nothing measures it."""

    name: str
    age_ms: int
    quality: float | None
    signal_dbm: int | None


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """What is known of one radio. Facts are None where the node did not tell; `age_s` is how old they are, for a node
    that does not answer the age of what was last known (None: nothing ever was)."""

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
    """Processes that want to run, per processor, over the last minute."""
    memory_free: float | None = None
    """Share of memory available, 0..1."""
    flash_free_bytes: int | None = None
    clock_offset_s: float | None = None
    channels: tuple[int, ...] = ()
    tx_power_dbm: float | None = None
    lan_ports: tuple[str, ...] | None = None
    """What its LAN bridge joins now."""
    neighbors: tuple[Neighbor, ...] = ()
    is_path_known: bool = True
    """Whether enough was asked to tell its path; then no `hops` means that there is none."""
    hops: int | None = None
    quality: float | None = None
    """Of the whole path to the base, 0..1."""
    via: str = ""
    is_cut_vertex: bool = False
    relays: tuple[str, ...] = ()
    """Nodes whose path to the base leads through it."""
    heard_by: tuple[Sighting, ...] = ()
    last_known: Mapping[str, str] | None = None

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def state(self) -> NodeState | None:
        return self.node.state


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """One topic at one robot. `limit_s` is the silence that its rate and deadline allow (None: none is too long);
    `trouble` says what is wrong, `code` in one word (`undeclared`, `silent`, `not-arriving`), both empty when nothing
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
    """What is known of one robot's computer and its udp_mesh daemon; `facts` None where it gave no answer.

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
    """Whether its configuration could be held against the inventory."""
    urgent_bytes: int = 0
    """What waits on the priorities of emergency stops and commands."""
    base_round_trip_s: float | None = None
    heard_by: tuple[Sighting, ...] = ()
    last_known: Mapping[str, str] | None = None

    @property
    def name(self) -> str:
        return self.robot.name


@dataclass(frozen=True, slots=True)
class FleetStatus:
    """Every managed radio and every robot with a computer, at `taken_s` (Unix time), from a look of `took_s`.

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
        """Of radios and robots together."""
        return sum(one.health is health for one in self)

    @property
    def exit_code(self) -> ExitCode:
        """All well 0, something degraded 1, somebody who must answer does not 3."""
        if self.count(Health.UNREACHABLE):
            return ExitCode.UNREACHABLE
        is_fleet_degraded = any(alarm.level > Level.NOTE for alarm in self.alarms)
        return ExitCode.FINDINGS if self.count(Health.DEGRADED) or self.strangers or is_fleet_degraded else ExitCode.OK
