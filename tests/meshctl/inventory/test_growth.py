"""Loading grows with the fleet and no faster, counted in calls, which no busy machine can change."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from meshctl.inventory import load
from tests.meshctl.inventory.inventories import HEAD


def _calls(path: Path) -> int:
    """Python functions and C functions called while `path` is loaded."""
    count = 0

    def count_call(_frame: FrameType, event: str, _argument: Any) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(count_call)
    try:
        loaded = load(path)
    finally:
        sys.setprofile(before)
    assert loaded.fleet is not None, loaded.diagnostics
    return count


def _one_by_one(nodes: int) -> str:
    entries = (
        f"  n{number}: {{groups: [g{number // 10}], address: 10.0.{number // 250}.{number % 250}, label: N{number}}}\n"
        for number in range(nodes)
    )
    groups = (f"  g{number}: {{hardware: rocket, state: spare}}\n" for number in range(nodes // 10 + 1))
    robots = (f"  r{number}: {{nodes: [n{number}]}}\n" for number in range(nodes))
    return HEAD + "groups:\n" + "".join(groups) + "nodes:\n" + "".join(entries) + "robots:\n" + "".join(robots)


def _in_a_range(nodes: int) -> str:
    return f"{HEAD}nodes: {{'n[1-{nodes}]': {{hardware: rocket, address: {{from: 10.0.0.0}}}}}}\n"


def _through_groups(nodes: int) -> str:
    chain = (f"  g{number}: {{inherits: [g{number + 1}]}}\n" for number in range(nodes))
    text = f"{HEAD}groups:\n{''.join(chain)}  g{nodes}: {{hardware: rocket}}\n"
    return text + "nodes: {n: {groups: [g0], address: 10.0.0.1}}\n"


def _with_entries_of_their_own(nodes: int) -> str:
    own = "".join(f"  n{number}: {{state: lost}}\n" for number in range(1, nodes + 1))
    return f"{HEAD}nodes:\n  n[1-{nodes}]: {{hardware: rocket, address: {{rule: 10.0.0.0 + index}}}}\n{own}"


@pytest.mark.parametrize("shape", [_one_by_one, _in_a_range, _through_groups, _with_entries_of_their_own])
def test_the_cost_of_loading_grows_linearly_with_the_fleet(shape: Callable[[int], str], tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(shape(200))
    # what the first one in a process does once
    _calls(path)
    counts = []
    for nodes in (200, 400, 800):
        path.write_text(shape(nodes))
        counts.append(_calls(path))
    assert counts[2] - counts[1] < 2.1 * (counts[1] - counts[0])
