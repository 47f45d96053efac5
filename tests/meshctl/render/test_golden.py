"""Every release, back end and mode renders to the byte as recorded, and another reader reads the same in it."""

from __future__ import annotations

import io
import tarfile
from typing import Any

import pytest
from netjsonconfig.backends.openwrt.parser import OpenWrtParser

from meshctl.model import Fleet
from meshctl.render import Rendered, render_node
from meshctl.uci import Package
from tests.meshctl.render import fleets
from tests.meshctl.render.golden import FOLDER, cases, render_case

CASES = dict(cases())


@pytest.mark.parametrize("name", CASES)
def test_rendered_output_matches_the_golden_file(name: str) -> None:
    assert render_case(CASES[name]) == (FOLDER / f"{name}.txt").read_text(encoding="utf-8")


def test_no_golden_file_is_unused() -> None:
    assert {path.stem for path in FOLDER.glob("*.txt")} == set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_netjsonconfig_reads_the_same_values(name: str) -> None:
    rendered = _render(CASES[name])
    read = OpenWrtParser(_tar(rendered)).intermediate_data
    packages = [file.package for file in rendered.files if file.package is not None]
    assert {package.name: _blocks(package) for package in packages} == {
        name: [_normalized(block) for block in blocks] for name, blocks in read.items()
    }


def _render(fleet: Fleet) -> Rendered:
    name = next(iter(fleet.nodes))
    return render_node(fleet, name, fleets.secrets)


def _tar(rendered: Rendered) -> io.BytesIO:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as tar:
        for file in rendered.files:
            member = tarfile.TarInfo(file.path)
            member.size = len(file.content)
            tar.addfile(member, io.BytesIO(file.content))
    packed.seek(0)
    return packed


def _blocks(package: Package) -> list[dict[str, Any]]:
    """The tree in netjsonconfig's shape: it names anonymous sections by type and place."""
    blocks: list[dict[str, Any]] = []
    for index, section in enumerate(package.sections, 1):
        block: dict[str, Any] = {name: list(v) if isinstance(v, tuple) else v for name, v in section.options.items()}
        blocks.append({".type": section.type, ".name": section.name or f"{section.type}_{index}", **block})
    return blocks


def _normalized(block: dict[str, Any]) -> dict[str, Any]:
    """netjsonconfig turns device sections into interfaces of its own kind while it reads."""
    plain = dict(block)
    if plain.pop("bridge_21", False):
        plain[".type"] = "device"
    elif plain.get("type") == "device":
        plain[".type"] = plain.pop("type")
    return plain
