"""One node's state and the fleet's, as frozen values for tables, scripts and the go/no-go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum

from meshctl.errors import ExitCode
from meshctl.model import Node
from meshctl.topology import Sighting


class Level(IntEnum):
    """How much an alarm matters: NOTE informs, WARNING degrades a node, ERROR makes it unfit for the run."""

    NOTE = 0
    WARNING = 1
    ERROR = 2

    @property
    def text(self) -> str:
        return self.name.lower()


class Health(Enum):
    """One word per node. OFF: silent, and expected to be (carried, spare). UNREACHABLE: silent, and missed."""

    OK = "ok"
    DEGRADED = "degraded"
    UNREACHABLE = "unreachable"
    OFF = "off"


@dataclass(frozen=True, slots=True)
class Alarm:
    """`code` is stable, for filters; `text` one sentence for a person."""

    level: Level
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A node heard directly. `quality` 0..1, None where nothing measures it."""

    name: str
    age_ms: int
    quality: float | None
    signal_dbm: int | None


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """What is known of one node. Facts are None where the node did not tell; `age_s` is how old they are, for a node
    that does not answer the age of what was last known (None: nothing ever was)."""

    node: Node
    health: Health
    alarms: tuple[Alarm, ...]
    age_s: float | None
    silent_because: str = ""
    version: str = ""
    revision: str = ""
    drift: tuple[str, ...] | None = None
    uptime_s: float | None = None
    memory_free: float | None = None
    """Share of memory available, 0..1."""
    flash_free_bytes: int | None = None
    clock_offset_s: float | None = None
    channels: tuple[int, ...] = ()
    tx_power_dbm: float | None = None
    lan_ports: tuple[str, ...] | None = None
    neighbours: tuple[Neighbour, ...] = ()
    hops: int | None = None
    quality: float | None = None
    """Of the whole path to the base, 0..1."""
    via: str = ""
    is_cut_vertex: bool = False
    heard_by: tuple[Sighting, ...] = ()
    last_known: Mapping[str, str] | None = None

    @property
    def name(self) -> str:
        return self.node.name


@dataclass(frozen=True, slots=True)
class FleetStatus:
    """Every managed node; `strangers` are MACs heard in the mesh that belong to no node of the inventory."""

    fleet: str
    taken_s: float
    entry: str
    nodes: tuple[NodeStatus, ...]
    strangers: tuple[str, ...] = ()

    def count(self, health: Health) -> int:
        return sum(node.health is health for node in self.nodes)

    @property
    def exit_code(self) -> ExitCode:
        """All well 0, something degraded 1, a node that must answer does not 3."""
        if self.count(Health.UNREACHABLE):
            return ExitCode.UNREACHABLE
        return ExitCode.FINDINGS if self.count(Health.DEGRADED) or self.strangers else ExitCode.OK
