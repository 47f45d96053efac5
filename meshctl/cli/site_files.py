"""Files that `plan` and `apply` at a site exchange with the worker that starts them, next to its part of the inventory.

They have the nodes' keys. Like the part itself, they are deleted when the run is over, so a gateway keeps no key of a
node: the operator's computer has what a run replaced, and sends it along with a rollback.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from meshctl.apply.prepare import Prepared
from meshctl.apply.rollback import EarlierState, EarlierStates, before_state
from meshctl.cli.context import Session
from meshctl.errors import InputError
from meshctl.plan import Verdict
from meshctl.sites.part import EARLIER_FILE, FILES_VARIABLE, REPLACED_FILE


def runs_at_site() -> bool:
    """Whether a worker has started this command."""
    return bool(os.environ.get(FILES_VARIABLE))


def with_states(opened: Session, states: Mapping[str, EarlierState]) -> Session:
    """A session that returns these nodes to earlier states instead of what the inventory says."""
    renderer = opened.renderer
    return replace(opened, renderer=EarlierStates(opened.fleet, renderer.secrets, renderer.templates, states))


def with_sent_states(opened: Session) -> Session:
    """The session of a command at a site, with the earlier states that the operator sent along with a rollback."""
    path = _path(EARLIER_FILE)
    if path is None or not path.exists():
        return opened
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        states = {str(name): EarlierState.from_json(item) for name, item in found.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not the states of a rollback: {error}") from error
    return with_states(opened, states)


def replaced_by(prepared: Prepared) -> dict[str, Any]:
    """Node -> what the plan replaces on it, as JSON."""
    observations, desired = prepared.observed.observations, prepared.desired
    return {
        plan.node: before_state(plan, desired[plan.node], observations[plan.node]).to_json()
        for plan in prepared.plan.of(Verdict.CHANGE)
    }


def hand_over(prepared: Prepared) -> None:
    """Let the worker tell the operator what the plan would replace."""
    path = _path(REPLACED_FILE)
    if path is not None:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as file:
            json.dump(replaced_by(prepared), file)


def _path(name: str) -> Path | None:
    folder = os.environ.get(FILES_VARIABLE, "")
    return Path(folder, name) if folder else None
