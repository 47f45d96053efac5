"""Each mesh of a simultaneous change must reach its quorum, not only most of the nodes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

from meshctl.apply.context import NodeContext
from meshctl.apply.mesh_commit import Participant, quorum_of, short_of_quorum


def participant(*meshes: str) -> Participant:
    return Participant(cast("NodeContext", SimpleNamespace(plan=SimpleNamespace(parted_from=meshes))))


MAIN = [participant("main") for _ in range(4)]
BOTH = participant("main", "far")
FAR = [participant("far"), participant("far")]
EVERYBODY = (*MAIN, BOTH, *FAR)


def test_a_quorum_is_counted_in_each_mesh() -> None:
    assert quorum_of(EVERYBODY, 0.5) == {"main": 3, "far": 2}
    assert quorum_of(MAIN, 0.0) == {"main": 1}


def test_the_quorum_of_one_mesh_does_not_count_for_another() -> None:
    needed = quorum_of(EVERYBODY, 0.5)
    assert short_of_quorum((*MAIN, BOTH), needed) == "1 of mesh far rejoined, 2 required"
    assert short_of_quorum(FAR, needed) == "0 of mesh main rejoined, 3 required"
    assert short_of_quorum((*MAIN[:2], BOTH, *FAR[:1]), needed) == ""
