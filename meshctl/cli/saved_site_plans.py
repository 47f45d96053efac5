"""A saved plan whose nodes are at several sites: one file with the plan of each site and that of the operator's nodes.

Each part is a plan as `meshctl.plan.saved` writes it, so the file has masked differences and salted fingerprints, no
secret. A site that could not plan is in it with the reason, and its nodes are refused when the file is applied.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from meshctl.errors import InputError
from meshctl.model import Fleet
from meshctl.plan.saved import SavedPlan, dump, load

FORMAT = "meshctl-site-plans"
FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True)
class Unplanned:
    """The nodes of a site that could not plan, and why."""

    nodes: tuple[str, ...]
    error: str


@dataclass(frozen=True, slots=True)
class SavedSitePlans:
    """`direct` is the plan of the nodes that the operator's computer changes itself."""

    fleet: str
    direct: SavedPlan | None
    sites: Mapping[str, SavedPlan]
    unplanned: Mapping[str, Unplanned]

    @property
    def with_firmware(self) -> bool:
        plans = (self.direct, *self.sites.values())
        return any(saved.with_firmware for saved in plans if saved is not None)


def dump_site_plans(saved: SavedSitePlans) -> str:
    missing = {name: {"error": each.error, "nodes": each.nodes} for name, each in saved.unplanned.items()}
    document = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "fleet": saved.fleet,
        "direct": None if saved.direct is None else json.loads(dump(saved.direct)),
        "sites": {name: json.loads(dump(plan)) for name, plan in saved.sites.items()} | missing,
    }
    return json.dumps(document, indent=1).replace("\x7f", "\\u007f") + "\n"


def load_site_plans(text: str, file: str) -> SavedSitePlans | None:
    """The plans that `dump_site_plans` wrote; None for anything else. Raises InputError for damaged ones."""
    try:
        document = json.loads(text)
    except ValueError:
        return None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        return None
    if document.get("version") != FORMAT_VERSION:
        raise InputError(
            f"{file}: expected plans of version {FORMAT_VERSION}, found {document.get('version')!r}",
            hint="make a new plan with this version of meshctl",
        )
    try:
        direct, sites = document["direct"], dict(document["sites"])
        missing = {name: _unplanned(said) for name, said in sites.items() if "error" in said}
        planned = {name: said for name, said in sites.items() if name not in missing}
        return SavedSitePlans(
            str(document["fleet"]),
            None if direct is None else load(json.dumps(direct), file),
            {name: load(json.dumps(said), f"{file}, site {name}") for name, said in planned.items()},
            missing,
        )
    except (KeyError, TypeError, ValueError) as error:
        what = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{file}: damaged plan: {what}", hint="make a new plan") from error


def _unplanned(said: Mapping[str, Any]) -> Unplanned:
    return Unplanned(tuple(map(str, said["nodes"])), str(said["error"]))


def check_placement(saved: SavedSitePlans, fleet: Fleet, file: str) -> None:
    """Raises InputError unless the plans are of this fleet, and each node is still where it was planned."""
    if saved.fleet != fleet.name:
        raise InputError(f"{file} is for fleet {saved.fleet}, but the inventory is of {fleet.name}")
    planned = {name: tuple(plan.plan.nodes) for name, plan in saved.sites.items()}
    for site, names in (planned | {name: each.nodes for name, each in saved.unplanned.items()}).items():
        for name in names:
            node = fleet.nodes.get(name)
            worker = None if node is None else fleet.worker_site(node)
            if worker is None or worker.name != site:
                raise InputError(
                    f"{file}: the worker of site {site} no longer provisions {name}", hint="make a new plan"
                )
