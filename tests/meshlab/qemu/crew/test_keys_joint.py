"""New keys over the meshes that use them: for 802.11s with SAE only, and for both meshes of a team simultaneously."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import pytest

from tests.meshlab.qemu.conftest import until
from tests.meshlab.qemu.crew.conftest import FIELDED, Crew
from tests.meshlab.qemu.crew.test_encrypted import TWINS, all_authorized, heard_over, keys

pytestmark = [pytest.mark.proof, pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]


def results(events: Iterable[dict[str, Any]]) -> dict[str, str]:
    return {event["node"]: event["outcome"]["result"] for event in events if event["event"] == "finished"}


def works(crew: Crew) -> bool:
    """Whether every radio is authorized at its neighbors, and unicast passes every link."""
    both = all(heard_over(crew, name)["mesh1"] == {other} for name, other in zip(TWINS, TWINS[::-1], strict=True))
    return both and all_authorized(crew) and crew.answers("base-station", "10.42.0.10")


def switches(crew: Crew) -> list[list[str]]:
    """The nodes of each simultaneous change that meshctl plans now."""
    plan = crew.fleet.directory / "plan.json"
    crew.meshctl("plan", "--out", str(plan), *FIELDED)
    stages = json.loads(plan.read_text(encoding="utf-8"))["stages"]
    return [sorted(stage["nodes"]) for stage in stages if stage["kind"] == "switch"]


def test_changing_the_key_of_the_sae_mesh_leaves_the_other_mesh_unchanged(crew: Crew) -> None:
    (main,) = keys(crew)["main"]
    crew.write_keys(main=main, fast="a new word for five gigahertz")
    assert switches(crew) == [sorted(TWINS)]
    ended = results(crew.provision(*FIELDED)[-1])
    assert {ended[name] for name in TWINS} <= {"done", "unchanged"}
    assert {name: ended[name] for name in FIELDED if name not in TWINS} == {"base": "unchanged", "b01": "unchanged"}
    assert keys(crew) == {"main": {main}, "fast": {"a new word for five gigahertz"}}
    crew.settle()
    until(lambda: works(crew), "both radios of both nodes to know each other with the new key")


def test_keys_of_both_meshes_change_simultaneously(crew: Crew) -> None:
    crew.write_keys(main="new for all of them", fast="new for the fast ones, too")
    # the two meshes share the nodes with two radios, whose files change together: so there is one simultaneous change
    assert switches(crew) == [sorted(FIELDED)]
    ended = results(crew.provision(*FIELDED)[-1])
    assert set(ended) == set(FIELDED)
    assert set(ended.values()) <= {"done", "unchanged"}
    assert keys(crew) == {"main": {"new for all of them"}, "fast": {"new for the fast ones, too"}}
    crew.settle()
    until(lambda: works(crew), "every neighbor to be authorized with the new keys")
    until(lambda: crew.meshctl("provision", "--check", *FIELDED, expect=None).status == 0, "nothing left to change")
