"""Sends that are not needed any more stop halfway."""

from __future__ import annotations

from tests.udp_mesh.core.logs.team import LogTeam
from udp_mesh.core.settings import Log, Topic

SLOW_BITS_PER_S = 200_000.0


def carried_bytes(team: LogTeam, source: str, target: str) -> int:
    return team.pipes[source, target].carried_bytes


def test_the_rest_of_an_item_that_the_reader_got_from_another_is_not_sent() -> None:
    team = LogTeam("base", "husky", "spot")
    size = 400_000
    team.publish("spot", b"x" * size)
    team.meet("spot", "husky", seconds=8)
    team.pipes["spot", "base"].rate_bits_per_s = SLOW_BITS_PER_S
    team.connect("spot", "base")
    team.run(4)
    team.connect("husky", "base")
    logs = team.nodes["base"]._logs
    assert logs is not None
    # The slow source is silent in the base's view, which requests from the carrier.
    logs.replicator.peer_silent("spot", True)
    team.run(30)
    assert len(team.read("base")) == 1
    assert carried_bytes(team, "spot", "base") < size * 3 / 4
    serving = team.nodes["spot"]._logs
    assert serving is not None
    assert not serving.replicator._serving._messages


def test_an_item_that_became_too_old_is_not_sent_any_further() -> None:
    topic = Topic("artifact", priority=4, log=Log(readers=("base",), max_age_s=6.0))
    team = LogTeam("base", "spot", topics=[topic])
    size = 800_000
    team.pipes["spot", "base"].rate_bits_per_s = SLOW_BITS_PER_S
    team.connect("spot", "base")
    team.run(3)
    team.publish("spot", b"x" * size)
    team.run(40)
    assert team.read("base") == []
    assert carried_bytes(team, "spot", "base") < size / 2
