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
from meshctl.plan.saved import SavedPlan, as_text, check_version, damaged, document_of, from_document

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
        "direct": None if saved.direct is None else document_of(saved.direct),
        "sites": {name: document_of(plan) for name, plan in saved.sites.items()} | missing,
    }
    return as_text(document)


def load_site_plans(text: str, file: str) -> SavedSitePlans | None:
    """The plans that `dump_site_plans` wrote; None for anything else. Raises InputError for damaged ones."""
    try:
        document = json.loads(text)
    except ValueError:
        return None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        return None
    check_version(document, FORMAT_VERSION, "plans", file)
    try:
        direct, sites = document["direct"], dict(document["sites"])
        missing = {name: _unplanned(entry) for name, entry in sites.items() if "error" in entry}
        planned = {name: entry for name, entry in sites.items() if name not in missing}
        return SavedSitePlans(
            str(document["fleet"]),
            None if direct is None else from_document(direct, file),
            {name: from_document(entry, f"{file}, site {name}") for name, entry in planned.items()},
            missing,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(file, error) from error


def _unplanned(entry: Mapping[str, Any]) -> Unplanned:
    return Unplanned(tuple(map(str, entry["nodes"])), str(entry["error"]))


def check_fleet(planned: str, fleet: Fleet, file: str) -> None:
    """Raises InputError for the plan of another fleet."""
    if planned != fleet.name:
        raise InputError(f"{file} is for fleet {planned}, but the inventory is of {fleet.name}")


def check_placement(saved: SavedSitePlans, fleet: Fleet, file: str) -> None:
    """Raises InputError unless the plans are of this fleet, and each node is still where it was planned."""
    check_fleet(saved.fleet, fleet, file)
    planned = {name: tuple(plan.plan.nodes) for name, plan in saved.sites.items()}
    for site, names in (planned | {name: each.nodes for name, each in saved.unplanned.items()}).items():
        for name in names:
            node = fleet.nodes.get(name)
            worker = None if node is None else fleet.worker_site(node)
            if worker is None or worker.name != site:
                raise InputError(
                    f"{file}: the worker of site {site} no longer provisions {name}", hint="make a new plan"
                )
