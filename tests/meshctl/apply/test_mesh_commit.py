"""Laws of a switch of whole meshes: each mesh has to meet again, not only most of the nodes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

from meshctl.apply.context import NodeContext
from meshctl.apply.mesh_commit import Participant, quorum_of, short_of_quorum


def member(*meshes: str) -> Participant:
    return Participant(cast("NodeContext", SimpleNamespace(plan=SimpleNamespace(parted_from=meshes))))


MAIN = [member("main") for _ in range(4)]
BOTH = member("main", "far")
FAR = [member("far"), member("far")]
EVERYBODY = (*MAIN, BOTH, *FAR)


def test_a_quorum_is_counted_in_each_mesh() -> None:
    assert quorum_of(EVERYBODY, 0.5) == {"main": 3, "far": 2}
    assert quorum_of(MAIN, 0.0) == {"main": 1}


def test_one_mesh_that_does_not_meet_again_is_not_made_up_for_by_another() -> None:
    needed = quorum_of(EVERYBODY, 0.5)
    assert short_of_quorum((*MAIN, BOTH), needed) == "1 of mesh far met again, 2 needed"
    assert short_of_quorum(FAR, needed) == "0 of mesh main met again, 3 needed"
    assert short_of_quorum((*MAIN[:2], BOTH, *FAR[:1]), needed) == ""
