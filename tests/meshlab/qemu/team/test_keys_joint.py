"""New keys over the meshes that use them: for 802.11s with SAE only, and for both meshes of a team simultaneously."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import pytest

from tests.meshlab.qemu.conftest import until
from tests.meshlab.qemu.team.conftest import FIELDED, Team
from tests.meshlab.qemu.team.test_encrypted import TWINS, all_authorized, heard_over, keys

pytestmark = [pytest.mark.proof, pytest.mark.lab, pytest.mark.xdist_group("lab-real-team"), pytest.mark.timeout(1800)]


def results(events: Iterable[dict[str, Any]]) -> dict[str, str]:
    return {event["node"]: event["outcome"]["result"] for event in events if event["event"] == "finished"}


def works(team: Team) -> bool:
    """Whether every radio is authorized at its neighbors, and unicast passes every link."""
    both = all(heard_over(team, name)["mesh1"] == {other} for name, other in zip(TWINS, TWINS[::-1], strict=True))
    return both and all_authorized(team) and team.answers("base-station", "10.42.0.10")


def switches(team: Team) -> list[list[str]]:
    """The nodes of each simultaneous change that meshctl plans now."""
    plan = team.fleet.directory / "plan.json"
    team.meshctl("plan", "--out", str(plan), *FIELDED)
    stages = json.loads(plan.read_text(encoding="utf-8"))["stages"]
    return [sorted(stage["nodes"]) for stage in stages if stage["kind"] == "switch"]


def test_changing_the_key_of_the_sae_mesh_leaves_the_other_mesh_unchanged(team: Team) -> None:
    (main,) = keys(team)["main"]
    team.write_keys(main=main, fast="a new word for five gigahertz")
    assert switches(team) == [sorted(TWINS)]
    ended = results(team.provision(*FIELDED)[-1])
    assert {ended[name] for name in TWINS} <= {"done", "unchanged"}
    assert {name: ended[name] for name in FIELDED if name not in TWINS} == {"base": "unchanged", "b01": "unchanged"}
    assert keys(team) == {"main": {main}, "fast": {"a new word for five gigahertz"}}
    team.settle()
    until(lambda: works(team), "both radios of both nodes to know each other with the new key")


def test_keys_of_both_meshes_change_simultaneously(team: Team) -> None:
    team.write_keys(main="new for all of them", fast="new for the fast ones, too")
    # the two meshes share the nodes with two radios, whose files change together: so there is one simultaneous change
    assert switches(team) == [sorted(FIELDED)]
    ended = results(team.provision(*FIELDED)[-1])
    assert set(ended) == set(FIELDED)
    assert set(ended.values()) <= {"done", "unchanged"}
    assert keys(team) == {"main": {"new for all of them"}, "fast": {"new for the fast ones, too"}}
    team.settle()
    until(lambda: works(team), "every neighbor to be authorized with the new keys")
    until(lambda: team.meshctl("provision", "--check", *FIELDED, expect=None).status == 0, "nothing left to change")
