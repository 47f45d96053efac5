"""What makes a robot healthy after a switch, and the reasons otherwise."""

from __future__ import annotations

import pytest

from meshctl.robots.scripts.health import (
    BRIDGE_STEADY_S,
    BRIDGE_TOPIC,
    STEADY_S,
    Baseline,
    HealthSnapshot,
    ServiceState,
    flowing,
    problems,
)

NOW_S = 1000.0
DAEMON = ServiceState("udp-mesh.service", "active", "running", "success", "0", NOW_S - 60)
BRIDGE = DAEMON._replace(name="udp-mesh-ros1.service")
NOTHING = Baseline([], {}, "")


def _topic(name: str, received: int = 0, *, configured: bool = True) -> dict[str, object]:
    return {"name": name, "configured": configured, "received_messages": received}


def _look(*units: ServiceState, online: tuple[str, ...] = (), boot: str = "b", received: int = 0) -> HealthSnapshot:
    peers = [{"name": name, "online": True} for name in online] + [{"name": "off", "online": False}]
    topics = [_topic("estop"), _topic("video", received)]
    return HealthSnapshot(list(units or (DAEMON,)), {"boot": boot, "conditions": {"peers": peers}}, topics)


def _ill(look: HealthSnapshot, before: Baseline = NOTHING, wanted: tuple[str, ...] = ("estop", "video")) -> str:
    return problems(look, list(wanted), before, NOW_S)


def test_a_robot_with_its_previous_peers_and_topics_is_healthy() -> None:
    assert _ill(_look()) == ""
    before = Baseline(["base"], {"video": 700}, "a")
    assert _ill(_look(DAEMON, BRIDGE, online=("base", "husky2"), received=1), before) == ""


@pytest.mark.parametrize(
    ("look", "before", "reason"),
    [
        (
            _look(DAEMON._replace(active="activating", sub="auto-restart", result="exit-code", restarts="3")),
            NOTHING,
            "the daemon does not run: systemd says activating (auto-restart, exit-code, restarted 3 times)",
        ),
        (_look(DAEMON, BRIDGE._replace(active="failed", sub="failed")), NOTHING, "the ROS bridge does not run"),
        (HealthSnapshot([DAEMON], {}, [], "timed out"), NOTHING, "the daemon does not answer: timed out"),
        (_look(online=("base",)), Baseline(["base", "husky2"], {}, "b"), "are not seen: husky2"),
        (_look(), Baseline([], {"video": 5}, "a"), "topics flowed before and receive nothing: video"),
        (_look(DAEMON._replace(started_s=NOW_S - STEADY_S / 2)), NOTHING, "the daemon has just started"),
        (_look(DAEMON, BRIDGE._replace(started_s=NOW_S - STEADY_S)), NOTHING, "the ROS bridge has just started"),
    ],
)
def test_a_health_problem_is_described_by_its_reason(look: HealthSnapshot, before: Baseline, reason: str) -> None:
    assert reason in _ill(look, before)


def test_a_bridge_connected_to_the_daemon_is_healthy_without_a_longer_wait() -> None:
    seen = _look(DAEMON, BRIDGE._replace(started_s=NOW_S - STEADY_S))
    assert _ill(seen._replace(topics=[*seen.topics, _topic(BRIDGE_TOPIC)])) == ""
    assert _ill(_look(DAEMON, BRIDGE._replace(started_s=NOW_S - BRIDGE_STEADY_S))) == "", (
        "there may be no ROS master yet"
    )


def test_a_topic_absent_or_not_configured_is_missing() -> None:
    assert _ill(_look(), wanted=("estop", "lidar")) == "topics are missing: lidar"
    seen = _look()._replace(topics=[_topic("estop"), _topic("video", configured=False)])
    assert _ill(seen) == "topics are missing: video"


def test_after_a_reload_message_counts_must_keep_increasing() -> None:
    before = Baseline([], {"video": 5}, "b")
    assert "receive nothing" in _ill(_look(boot="b", received=5), before)
    assert _ill(_look(boot="b", received=6), before) == ""


def test_a_removed_topic_need_not_flow() -> None:
    assert _ill(_look(), Baseline([], {"gone": 5}, "a")) == ""


def test_a_single_message_does_not_count_as_flow() -> None:
    first = [_topic("status", 10), _topic("video", 10)]
    then = [_topic("status", 11), _topic("video", 40), _topic("new", 2)]
    assert flowing(first, then) == {"video": 40, "new": 2}
