"""Golden files: one text per release, back end and mode, with everything a node gets.

`python -m tests.meshctl.render.golden` rewrites them; check `git diff` before you commit them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from ipaddress import IPv4Address
from pathlib import Path

from meshctl.model import Backend, Fleet, LanFilter, Mesh, OperatorParts, Release
from meshctl.render import Rendered, render_node
from tests.meshctl.render import fleets

FOLDER = Path(__file__).parent
PARTS = OperatorParts(
    templates="operator_parts",
    packages=("operator-daemon",),
    service="operator_daemon",
    interface="mm0",
    base=str(FOLDER.parent),
)


def cases() -> Iterator[tuple[str, Fleet]]:
    """Name and fleet of every golden file."""
    for release in Release:
        for mode, mesh in fleets.modes(release).items():
            for backend in Backend:
                yield f"{release}-{backend.value}-{mode}", _fleet(release, replace(mesh, backend=backend))
        yield f"{release}-router", fleets.routed_lans(release)
        yield f"{release}-lan-filter", fleets.fleet(fleets.node(release, lan_filter=LanFilter((5353,))))


def _fleet(release: Release, mesh: Mesh) -> Fleet:
    if mesh.backend is Backend.MESHMERIZE:
        mesh = replace(mesh, operator_parts=PARTS)
    return fleets.fleet(fleets.node(release, gateway=IPv4Address("10.42.0.254")), meshes=(mesh,))


def text(rendered: Rendered) -> str:
    """Everything a node gets, the key of the tests in plain sight."""
    head = [
        f"packages: {' '.join(rendered.packages)}",
        f"removed: {' '.join(rendered.removed_packages)}",
    ]
    files = [f"=== {file.path} {file.mode:04o}\n{file.content.decode().rstrip()}" for file in rendered.files]
    return "\n".join([*head, *files, ""])


def render_case(fleet: Fleet) -> str:
    """The golden text of the fleet's first node."""
    name = next(iter(fleet.nodes))
    return text(render_node(fleet, name, fleets.secrets))
