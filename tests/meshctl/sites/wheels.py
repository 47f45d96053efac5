"""The wheels of everything that meshctl requires, made of the packages that the tests themselves run with."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from meshctl.sites.gateway import requirements
from tests.meshctl.robots.wheels import repack


def required_wheels(directory: Path, extra: str = "") -> Path:
    """Write one wheel for each project that meshctl and one of its extras need, directly or not, into `directory`."""
    waiting = [Requirement(line) for line in requirements(extra)]
    found: dict[str, None] = {}
    while waiting:
        requirement = waiting.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        name = canonicalize_name(requirement.name)
        if name not in found:
            found[name] = None
            waiting += map(Requirement, importlib.metadata.requires(requirement.name) or ())
    return repack(directory, tuple(found))
