"""The plan as frozen values: steps of a node, stages of a fleet. It may be shown and stored: no secret is in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from types import MappingProxyType


class Verdict(Enum):
    """CHANGE: there is something to do. SAME: nothing. AWAY: it did not answer. REFUSED: meshctl will not touch it."""

    CHANGE = "change"
    SAME = "same"
    AWAY = "away"
    REFUSED = "refused"


class Cut(IntEnum):
    """What is interrupted while a change takes effect, the least first."""

    NOTHING = 0
    # new SSH logins, for about a second
    LOGIN = 1
    # the robot's wired LAN behind the node
    LAN = 2
    # the node's radio links: it and everything behind it
    MESH = 3
    # the whole node, for minutes
    NODE = 4

    @property
    def text(self) -> str:
        return ("nothing", "new logins for a second", "its LAN", "its mesh links", "the whole node, for minutes")[self]


@dataclass(frozen=True, slots=True)
class FileChange:
    """`kind` is `added`, `changed` or `removed`; `diff` a unified diff with secrets masked; `path` starts without /."""

    path: str
    kind: str
    diff: str


@dataclass(frozen=True, slots=True)
class Effect:
    """`service` is reloaded because of `why`, which cuts `cut`."""

    service: str
    cut: Cut
    why: str


@dataclass(frozen=True, slots=True)
class FirmwareStep:
    """Replace the firmware: from one revision to another, with the image of that name and hash."""

    image: str
    sha256: str
    from_revision: str
    to_revision: str


@dataclass(frozen=True, slots=True)
class PackageStep:
    """`install` are the missing packages, `files` the package files that bring them, `remove` what has to go first."""

    install: tuple[str, ...]
    files: tuple[str, ...]
    remove: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class NodePlan:
    """One node: what is done to it, in this order: firmware, packages, files.

    `observed` and `wanted` are fingerprints of what was seen and what is to be; `splits` names what parts
    the cell that it runs from the wanted one (`channel 6 -> 11`), `parted_from` which of its `meshes` that concerns;
    `has_cell` whether a radio is configured for some mesh now, `is_meshed` whether it is part of a running one.
    """

    node: str
    verdict: Verdict
    reason: str = ""
    hint: str = ""
    firmware: FirmwareStep | None = None
    packages: PackageStep | None = None
    files: tuple[FileChange, ...] = ()
    effects: tuple[Effect, ...] = ()
    splits: tuple[str, ...] = ()
    parted_from: tuple[str, ...] = ()
    meshes: tuple[str, ...] = ()
    has_cell: bool = False
    is_meshed: bool = False
    observed: str = ""
    wanted: str = ""
    notes: tuple[str, ...] = ()

    @property
    def cut(self) -> Cut:
        """The worst of what its steps interrupt."""
        return max((effect.cut for effect in self.effects), default=Cut.NOTHING)


class StageKind(Enum):
    """CANARY: one node alone, to see it work. FREE: nothing that is in use is cut. ROLLING: at most `max_down` at a
    time. SWITCH: a whole mesh at one moment. LAST: the node we stand on."""

    CANARY = "canary"
    FREE = "free"
    ROLLING = "rolling"
    SWITCH = "switch"
    LAST = "last"


@dataclass(frozen=True, slots=True)
class Stage:
    """Nodes in work together; the next stage begins when all of them have ended. `mesh` is set for a SWITCH:
    one mesh, or all that change with it (`main, far`)."""

    kind: StageKind
    nodes: tuple[str, ...]
    reason: str
    cuts_off: tuple[str, ...] = ()
    mesh: str = ""


@dataclass(frozen=True, slots=True)
class Plan:
    """The whole fleet. `entry` is the node we reach the mesh through; `notes` concern the fleet as a whole."""

    fleet: str
    created_s: float
    entry: str
    nodes: Mapping[str, NodePlan] = field(default_factory=lambda: MappingProxyType({}))
    stages: tuple[Stage, ...] = ()
    notes: tuple[str, ...] = ()
    # a reason why nothing of it may be applied as it stands
    refusal: str = ""
    refusal_hint: str = ""

    def of(self, verdict: Verdict) -> tuple[NodePlan, ...]:
        return tuple(node for node in self.nodes.values() if node.verdict is verdict)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to apply."""
        return not self.stages
