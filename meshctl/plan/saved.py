"""Save a plan as JSON and load it, so that exactly the reviewed plan is applied later.

`dump` and `load` are inverse; `as_agreed` compares a saved plan with a fresh one and keeps what still applies. The file
contains masked diffs and salted fingerprints, no secret.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import Enum
from types import MappingProxyType
from typing import Any

from meshctl.errors import InputError
from meshctl.plan.values import (
    Cut,
    Effect,
    FileChange,
    FirmwareStep,
    NodePlan,
    PackageStep,
    Plan,
    Stage,
    StageKind,
    Verdict,
    Way,
)

FORMAT = "meshctl-plan"
FORMAT_VERSION = 3


@dataclass(frozen=True, slots=True)
class SavedPlan:
    """`salt` is that of the fingerprints; `inventory` the path the plan was made from, as given."""

    plan: Plan
    salt: bytes
    inventory: str
    with_firmware: bool = True


def dump(saved: SavedPlan) -> str:
    return as_text(document_of(saved))


def as_text(document: Mapping[str, Any]) -> str:
    """A document as JSON text. Plans quote devices: what a terminal would obey is escaped."""
    return json.dumps(document, indent=1).replace("\x7f", "\\u007f") + "\n"


def document_of(saved: SavedPlan) -> dict[str, Any]:
    """The plan as values that JSON has."""
    plan = saved.plan
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "fleet": plan.fleet,
        "inventory": saved.inventory,
        "created_s": plan.created_s,
        # earlier versions of meshctl read `entry` alone
        "entry": plan.entries[0] if plan.entries else "",
        "entries": plan.entries,
        "salt": saved.salt.hex(),
        "with_firmware": saved.with_firmware,
        "refusal": plan.refusal,
        "refusal_hint": plan.refusal_hint,
        "notes": plan.notes,
        "ways": [{**_plain(way), "recommended": way.is_recommended} for way in plan.ways],
        "pace": plan.pace,
        "stages": [_plain(stage) for stage in plan.stages],
        "nodes": [_plain(node) for node in plan.nodes.values()],
    }


def _entries(document: Mapping[str, Any]) -> tuple[str, ...]:
    # plans of earlier versions have one
    found = document.get("entries", [document["entry"]])
    return tuple(name for name in _texts(found) if name)


def _plain(value: Any) -> dict[str, Any]:
    return asdict(
        value, dict_factory=lambda items: {key: item.value if isinstance(item, Enum) else item for key, item in items}
    )


def load(text: str, file: str) -> SavedPlan:
    """Load a plan that `dump` wrote. Raises InputError with the file name and the fault."""
    try:
        document = json.loads(text)
    except ValueError as error:
        raise InputError(f"{file}: expected a plan in JSON: {error}") from error
    return from_document(document, file)


def from_document(document: Any, file: str) -> SavedPlan:
    """The plan of `document_of`, read back from JSON. Raises InputError with the file name and the fault."""
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(f"{file}: expected a plan written by `meshctl plan --out`, found something else")
    check_version(document, FORMAT_VERSION, "a plan", file)
    try:
        nodes = [_node(node) for node in document["nodes"]]
        plan = Plan(
            str(document["fleet"]),
            float(document["created_s"]),
            _entries(document),
            MappingProxyType({node.node: node for node in nodes}),
            tuple(_stage(stage) for stage in document["stages"]),
            _texts(document["notes"]),
            str(document["refusal"]),
            str(document["refusal_hint"]),
            # plans of earlier versions have none
            tuple(_way(way) for way in document.get("ways", ())),
            str(document.get("pace", "")),
        )
        unknown = [name for stage in plan.stages for name in stage.nodes if name not in plan.nodes]
        if unknown:
            raise ValueError(f"stages name {', '.join(unknown)}, which is not in the plan")
        return SavedPlan(
            plan, bytes.fromhex(document["salt"]), str(document["inventory"]), bool(document["with_firmware"])
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise damaged(file, error) from error


def check_version(document: Mapping[str, Any], version: int, what: str, file: str) -> None:
    """Raises InputError for a document of another version."""
    if document.get("version") != version:
        raise InputError(
            f"{file}: expected {what} of version {version}, found {document.get('version')!r}",
            hint="make a new plan with this version of meshctl",
        )


def damaged(file: str, error: Exception) -> InputError:
    """The error for a document with this fault."""
    what = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
    return InputError(f"{file}: damaged plan: {what}", hint="make a new plan")


def _node(data: Mapping[str, Any]) -> NodePlan:
    firmware, packages = data["firmware"], data["packages"]
    return NodePlan(
        node=str(data["node"]),
        verdict=Verdict(data["verdict"]),
        reason=str(data["reason"]),
        hint=str(data["hint"]),
        firmware=None if firmware is None else FirmwareStep(**{key: str(text) for key, text in firmware.items()}),
        packages=None if packages is None else PackageStep(**{key: _texts(names) for key, names in packages.items()}),
        files=tuple(FileChange(**{key: str(text) for key, text in change.items()}) for change in data["files"]),
        # plans of earlier versions have none
        left_over=_texts(data.get("left_over", [])),
        effects=tuple(Effect(str(item["service"]), Cut(item["cut"]), str(item["why"])) for item in data["effects"]),
        splits=_texts(data["splits"]),
        parted_from=_texts(data["parted_from"]),
        # plans of earlier versions have none
        departs=_texts(data.get("departs", ())),
        meshes=_texts(data["meshes"]),
        has_cell=bool(data["has_cell"]),
        is_meshed=bool(data["is_meshed"]),
        observed=str(data["observed"]),
        wanted=str(data["wanted"]),
        notes=_texts(data["notes"]),
    )


def _stage(data: Mapping[str, Any]) -> Stage:
    return Stage(
        StageKind(data["kind"]),
        _texts(data["nodes"]),
        str(data["reason"]),
        _texts(data["cuts_off"]),
        str(data["mesh"]),
    )


def _way(data: Mapping[str, Any]) -> Way:
    return Way(
        str(data["name"]),
        int(data["stages"]),
        float(data["estimated_s"]),
        int(data["outages"]),
        str(data["risk"]),
        str(data["reason"]),
    )


def _texts(items: Any) -> tuple[str, ...]:
    if not isinstance(items, list):
        raise TypeError(f"expected a list, found {items!r}")
    return tuple(str(item) for item in items)


def stale_reason(agreed: NodePlan, now: NodePlan) -> str:
    """Why a node's saved plan is stale; empty when it still applies. Both plans must share a salt."""
    if now.verdict is Verdict.AWAY:
        return ""
    if agreed.wanted != now.wanted:
        return "the inventory has changed since the plan was made"
    if agreed.observed != now.observed:
        return "the node has changed since the plan was made"
    if now.verdict is Verdict.REFUSED and agreed.verdict is not Verdict.REFUSED:
        return now.reason
    return ""


def as_agreed(agreed: Plan, now: Plan) -> Plan:
    """The saved plan as far as it still applies: stale nodes are refused, unreachable ones are left out.

    `now` is a fresh plan under the same salt. A simultaneous change in which not all nodes can take part is refused.
    """
    nodes = {name: _still(old, now.nodes[name]) for name, old in agreed.nodes.items()}
    stages, refusal = [], agreed.refusal
    for stage in agreed.stages:
        ready = tuple(name for name in stage.nodes if nodes[name].verdict is Verdict.CHANGE)
        if stage.kind.is_simultaneous and len(ready) < len(stage.nodes):
            absent = ", ".join(sorted(set(stage.nodes) - set(ready)))
            what = "its cell simultaneously" if stage.kind is StageKind.SWITCH else "its nodes simultaneously"
            refusal = f"mesh {stage.mesh} changes {what}, but {absent} cannot take part as planned"
        if ready:
            stages.append(replace(stage, nodes=ready))
    return replace(agreed, nodes=MappingProxyType(nodes), stages=tuple(stages), refusal=refusal)


def _still(old: NodePlan, now: NodePlan) -> NodePlan:
    if old.verdict is not Verdict.CHANGE:
        if now.verdict is not Verdict.CHANGE:
            return now
        return replace(now, verdict=Verdict.REFUSED, reason="the saved plan does not change it")
    if now.verdict is Verdict.AWAY:
        return now
    why = stale_reason(old, now)
    return replace(old, verdict=Verdict.REFUSED, reason=why, hint="make a new plan") if why else old
