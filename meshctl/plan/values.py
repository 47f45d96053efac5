"""The plan as frozen values: steps of a node, stages of a fleet. It contains no secret."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum
from types import MappingProxyType


class Verdict(Enum):
    """CHANGE: something changes. SAME: nothing does. AWAY: unreachable. REFUSED: a precondition failed."""

    CHANGE = "change"
    SAME = "same"
    AWAY = "away"
    REFUSED = "refused"


class Cut(IntEnum):
    """The interruption that a change causes while it takes effect, the least first."""

    NOTHING = 0
    # new SSH logins, for about a second
    LOGIN = 1
    # the devices behind the node: on its wired LAN, at its access points
    LAN = 2
    # radio links that depend on its current range; all others stay up
    WEAK_LINKS = 3
    # the node's radio links: it and everything behind it
    MESH = 4
    # the whole node, for minutes
    NODE = 5

    @property
    def text(self) -> str:
        return (
            "nothing",
            "new logins for a second",
            "its LAN or access points",
            "weak mesh links, if any",
            "its mesh links",
            "the whole node, for minutes",
        )[self]


@dataclass(frozen=True, slots=True)
class FileChange:
    """`kind` is `added`, `changed` or `removed`; `diff` a unified diff with secrets masked; `path` starts without /."""

    path: str
    kind: str
    diff: str


@dataclass(frozen=True, slots=True)
class Effect:
    """`service` is reloaded because of `why`, which interrupts `cut`."""

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
    """`install`: missing packages; `files`: package files that provide them; `remove`: what is removed first."""

    install: tuple[str, ...]
    files: tuple[str, ...]
    remove: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class NodePlan:
    """The steps of one node, in this order: firmware, packages, files. `left_over` are radio interfaces that its
    configuration has turned off, but that transmit: the reload takes them down.

    `observed` and `wanted` are fingerprints of its observed and desired state. `splits` lists how its current cell
    differs from the planned one (`channel 6 -> 11`), `parted_from` which of its `meshes` that concerns. `departs`: of
    which ones the planned cell is not the inventory's, so that it leads away from the members there. `has_cell`: a
    radio is configured for a mesh now; `is_meshed`: the node is part of a running mesh.
    """

    node: str
    verdict: Verdict
    reason: str = ""
    hint: str = ""
    firmware: FirmwareStep | None = None
    packages: PackageStep | None = None
    files: tuple[FileChange, ...] = ()
    left_over: tuple[str, ...] = ()
    effects: tuple[Effect, ...] = ()
    splits: tuple[str, ...] = ()
    parted_from: tuple[str, ...] = ()
    departs: tuple[str, ...] = ()
    meshes: tuple[str, ...] = ()
    has_cell: bool = False
    is_meshed: bool = False
    observed: str = ""
    wanted: str = ""
    notes: tuple[str, ...] = ()

    def refused(self, reason: str, hint: str) -> NodePlan:
        """The same node, refused: nothing of it is changed."""
        return replace(
            self,
            verdict=Verdict.REFUSED,
            reason=reason,
            hint=hint,
            firmware=None,
            packages=None,
            files=(),
            left_over=(),
            effects=(),
        )

    @property
    def reloads(self) -> bool:
        """Whether files or services change: all but firmware and packages."""
        return bool(self.files or self.left_over)

    @property
    def cut(self) -> Cut:
        """The most disruptive of its effects."""
        return max((effect.cut for effect in self.effects), default=Cut.NOTHING)


class StageKind(Enum):
    """CANARY: one node alone, as a test. FREE: interrupts nothing in use. ROLLING: at most `max_down` at a time.
    SWITCH: a whole mesh simultaneously, because its cell changes. TOGETHER: all nodes of running meshes simultaneously,
    because the operator asked for it. LAST: an entry node."""

    CANARY = "canary"
    FREE = "free"
    ROLLING = "rolling"
    SWITCH = "switch"
    TOGETHER = "together"
    LAST = "last"

    @property
    def is_simultaneous(self) -> bool:
        """Whether its nodes change simultaneously, and all of them roll back without a quorum."""
        return self in (StageKind.SWITCH, StageKind.TOGETHER)


@dataclass(frozen=True, slots=True)
class Stage:
    """Nodes changed together; the next stage starts when all of them have ended. `mesh` is set for a SWITCH and for
    TOGETHER: one mesh, or all that change with it (`main, far`)."""

    kind: StageKind
    nodes: tuple[str, ...]
    reason: str
    cuts_off: tuple[str, ...] = ()
    mesh: str = ""


@dataclass(frozen=True, slots=True)
class Way:
    """One of two ways to execute a plan: `in order` or `together`. `outages` is how often the worst affected node is
    down or without a path to an entry; `reason` is set for the recommended way."""

    name: str
    stages: int
    estimated_s: float
    outages: int
    risk: str
    reason: str = ""

    @property
    def is_recommended(self) -> bool:
        return bool(self.reason)


@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of a fleet. Its meshes are reached through `entries`; `notes` concern the whole fleet.

    `ways` are both ways to execute it, if they differ; `stages` are those of the one that was chosen. `pace` says where
    their times come from.
    """

    fleet: str
    created_s: float
    entries: tuple[str, ...]
    nodes: Mapping[str, NodePlan] = field(default_factory=lambda: MappingProxyType({}))
    stages: tuple[Stage, ...] = ()
    notes: tuple[str, ...] = ()
    # why the plan as a whole must not be applied
    refusal: str = ""
    refusal_hint: str = ""
    ways: tuple[Way, ...] = ()
    pace: str = ""

    def of(self, verdict: Verdict) -> tuple[NodePlan, ...]:
        return tuple(node for node in self.nodes.values() if node.verdict is verdict)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to apply."""
        return not self.stages
