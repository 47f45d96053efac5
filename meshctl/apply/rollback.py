"""Return nodes to their configuration from before a run: record it (`before_state`), plan it (`EarlierStates`).

A rollback is a plan like any other: `EarlierStates` stands in for the renderer of the inventory, so preconditions,
order, whole-mesh commits and proofs are those of `meshctl provision`. `irreversible` decides what cannot be taken back.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from meshctl.device.observation import Observation
from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.fleet import Outcome, Result
from meshctl.model import Node, Secret
from meshctl.model.ip import IpAddress
from meshctl.nodes.desired import Renderer
from meshctl.plan import DesiredState, NodePlan
from meshctl.plan.cell import Cell, cells, partitions
from meshctl.plan.masking import masked_text, secrets_of
from meshctl.plan.node import meshes_of
from meshctl.plan.observed_files import file_info, management_address, package_of, parsed, text_of
from meshctl.render import RenderedFile

# The replacement character stands for bytes that are not UTF-8, whose value the observation does not have.
_INEXACT = "\ufffd"
_NETWORK = "etc/config/network"


@dataclass(frozen=True, slots=True)
class EarlierFile:
    """A file from before a run; `text` is None for one that was missing or whose bytes are unknown."""

    path: str
    mode: int
    text: str | None = field(repr=False)


@dataclass(frozen=True, slots=True)
class EarlierState:
    """A node's files from before a run; `added` were created by it; `lasting` is what no file undoes."""

    files: tuple[EarlierFile, ...]
    added: tuple[str, ...] = ()
    lasting: str = ""

    @property
    def address(self) -> IpAddress | None:
        """Its management address at that time."""
        return management_address(next((file.text for file in self.files if file.path == _NETWORK), None))

    def to_json(self) -> dict[str, Any]:
        files = [[file.path, file.mode, file.text] for file in self.files]
        return {"files": files, "added": list(self.added), "lasting": self.lasting}

    @classmethod
    def from_json(cls, item: Mapping[str, Any]) -> EarlierState:
        files = tuple(EarlierFile(str(path), int(mode), text) for path, mode, text in item["files"])
        return cls(files, tuple(item["added"]), str(item["lasting"]))


def before_state(plan: NodePlan, desired: DesiredState, observation: Observation) -> EarlierState:
    """The contents of the node's managed files before its plan is executed."""
    files: list[EarlierFile] = []
    for file in desired.files:
        info, text = file_info(file.path, observation), text_of(file.path, observation)
        exact = text if text is not None and _INEXACT not in text else None
        files.append(EarlierFile(file.path, file.mode if info is None else info.mode, exact))
    lasting = ["flashed its firmware"] if plan.firmware is not None else []
    lasting += ["installed packages"] if plan.packages is not None else []
    added = tuple(change.path for change in plan.files if change.kind == "added")
    return EarlierState(tuple(files), added, " and ".join(lasting))


def irreversible(
    run_id: int,
    node: Node | None,
    outcome: Outcome,
    state: EarlierState | None,
    later_runs: Sequence[int],
    undoing: Collection[int] = (),
) -> str:
    """Why this node cannot be returned to before the run; empty if it can.

    `later_runs` changed it, oldest first; those of them that rolled back the run are in `undoing`.
    """
    if node is None:
        return "the inventory no longer manages it"
    if outcome.result is Result.UNCERTAIN:
        return f"the outcome of run {run_id} is uncertain: run `meshctl resume {run_id}` first"
    if later_runs and later_runs[-1] in undoing:
        return f"run {later_runs[-1]} has rolled it back already"
    if later_runs:
        return f"run {later_runs[-1]} changed it later: run `meshctl rollback {later_runs[-1]}` first"
    if state is None:
        return f"the files that run {run_id} replaced on it were not recorded"
    if state.lasting:
        return f"run {run_id} {state.lasting}, which no configuration undoes"
    if state.added:
        return f"run {run_id} created {', '.join('/' + path for path in state.added)}, which would stay"
    if inexact := [file.path for file in state.files if file.text is None]:
        return f"the earlier content of {', '.join('/' + path for path in inexact)} is unknown"
    if state.address is not None and state.address != node.address.ip:
        return f"its address was {state.address}: change it in the inventory and run `meshctl provision`"
    return ""


def without_undone(runs: Iterable[tuple[int, int | None]]) -> tuple[int, ...]:
    """The runs, oldest first, without those that a rollback has undone, and without that rollback.

    Each is (run, the run it undid or None).
    """
    left: list[int] = []
    for run_id, undone in runs:
        if undone is not None and undone in left:
            left.remove(undone)
        else:
            left.append(run_id)
    return tuple(left)


@dataclass(frozen=True, slots=True)
class EarlierStates(Renderer):
    """A renderer whose desired state of some nodes is an earlier one; others are rendered from the inventory."""

    states: Mapping[str, EarlierState] = field(default_factory=dict, repr=False)

    def desired(self, node: Node, observation: Observation | None = None) -> DesiredState:
        state = self.states.get(node.name)
        if state is None:
            return Renderer.desired(self, node, observation)
        files = tuple(_rendered(file) for file in state.files if file.text is not None)
        found = {secret.reveal() for file in files for secret in file.secrets}
        secrets = tuple(sorted(found, key=lambda secret: (-len(secret), secret)))
        return DesiredState(node, files, secrets, departs=self._departs(node, files, observation))

    def _departs(self, node: Node, files: Iterable[RenderedFile], observation: Observation | None) -> tuple[str, ...]:
        """The meshes whose cell was another one than in the inventory; all if that cannot be rendered now."""
        try:
            now = Renderer.desired(self, node, observation)
        except (InvalidInput, InputError):
            return node.meshes
        return meshes_of(node, partitions(_cells(now.files), _cells(files)))


def _cells(files: Iterable[RenderedFile]) -> dict[str, Cell]:
    packages = {file.package.name: file.package for file in files if file.package is not None}
    return cells(packages.get("wireless"), packages.get("network"))


def _rendered(file: EarlierFile) -> RenderedFile:
    text = file.text or ""
    content = text.encode("utf-8", "surrogateescape")
    name = package_of(file.path)
    package = None if name is None else parsed(text, name)
    if package is None:
        return RenderedFile(file.path, file.mode, content, text if name is None else "(not readable as UCI)\n")
    secrets = tuple(Secret(value) for value in secrets_of(package))
    return RenderedFile(file.path, file.mode, content, masked_text(package), secrets, package)
