"""Facts of robots: recorded outputs, what they mean, and the table."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

from meshctl.robots.expected_release import ExpectedRelease
from meshctl.robots.facts import RobotFacts, facts_object, parse_robot_facts
from meshctl.robots.scripts import script
from meshctl.robots.status_table import table

NOW_S = 1_800_000_000.0
WANTED = ExpectedRelease({"etc/udp-mesh.toml": "1111", "udp-mesh.service": "2222"}, {"udp-mesh": "9999"})

_SERVICES = """\
== services
Id=udp-mesh.service
LoadState=loaded
ActiveState=active
SubState=running
UnitFileState=enabled
NRestarts=2
Result=success

Id=udp-mesh-ros1.service
LoadState=not-found
ActiveState=inactive
SubState=dead
UnitFileState=
NRestarts=0
Result=success

== release
current=aaaa
previous=bbbb
proven=yes
file=1111  etc/udp-mesh.toml
file=2222  udp-mesh.service
wheel=9999  udp_mesh-0.1.0-py3-none-any.whl
wheel=8888  cffi-1.17.1-cp311-cp311-linux_x86_64.whl
== computer
now=1799999990
uptime=3600.25 7000.00
load=0.52 0.40 0.30 2/345 6789
cpus=4
MemTotal=8000000 kB
MemAvailable=5000000 kB
disk=60000000 20000000
"""


def _peer(name: str, online: bool, queues: list[dict[str, float]]) -> dict[str, object]:
    return {"name": name, "online": online, "heard_ago_s": 0.5, "round_trip_s": 0.01, "loss": 0.1, "queues": queues}


_STATUS = json.dumps(
    {
        "version": "0.1.0",
        "uptime_s": 3500.5,
        "keys": ["0011223344556677"],
        "unkeyed": False,
        "conditions": {
            "peers": [
                _peer("base", True, [{"priority": 9, "messages": 2, "bytes": 100, "oldest_s": 4.0}]),
                _peer("husky2", False, [{"priority": 9, "messages": 1, "bytes": 50, "oldest_s": 9.0}]),
            ]
        },
    },
    indent=2,
)
_TOPICS = json.dumps(
    {
        "topics": [
            {"name": "estop", "priority": 0, "sent_messages": 0, "sent_ago_s": None, "received_ago_s": None},
            {"name": "status", "priority": 5, "sent_messages": 7, "sent_ago_s": 1.5, "received_ago_s": 0.25},
        ]
    }
)
ANSWER = f"{_SERVICES}== status\n{_STATUS}\n== topics\n{_TOPICS}\n"


def _facts(text: str = ANSWER, wanted: ExpectedRelease = WANTED) -> RobotFacts:
    return parse_robot_facts("husky1", text, wanted, now_s=NOW_S)


def test_one_answer_has_service_release_daemon_and_computer() -> None:
    facts = _facts()
    assert facts.is_healthy
    assert (facts.service.active, facts.service.enabled, facts.service.restarts) == ("active", "enabled", 2)
    assert facts.bridge is None, "none is wanted and none is installed"
    assert (facts.release, facts.previous, facts.version, facts.drift) == ("aaaa", "bbbb", "0.1.0", ())
    assert facts.online == ("base",)
    assert facts.remark == "offline peers: husky2"
    (queue,) = facts.queues
    assert (queue.priority, queue.messages, queue.bytes, queue.oldest_s) == (9, 3, 150, 9.0)
    assert {topic.name: topic.last_ago_s for topic in facts.topics} == {"estop": None, "status": 0.25}
    computer = facts.computer
    assert (computer.uptime_s, computer.load, computer.cpus) == (3600.25, (0.52, 0.40, 0.30), 4)
    assert (computer.memory_kib, computer.memory_free_kib) == (8_000_000, 5_000_000)
    assert (computer.disk_kib, computer.disk_free_kib) == (60_000_000, 20_000_000)
    assert computer.clock_ahead_s == -10.0
    assert json.loads(json.dumps(facts_object(facts)))["peers"][0]["name"] == "base"


def test_what_a_silent_computer_leaves_unknown_is_null_in_json() -> None:
    """Scripts read `is_proven: true` and a disk of 0 KiB."""
    shown = facts_object(RobotFacts("husky1", error="cannot connect"))
    assert [shown[key] for key in ("seen_s", "is_proven", "unkeyed", "drift", "service")] == [None] * 5
    assert set(shown["computer"].values()) == {None}
    assert {"cpus", "disk_free_kib", "clock_ahead_s"} < set(shown["computer"])
    assert (shown["well"], shown["answers"], shown["error"]) == (False, False, "cannot connect")
    answered = facts_object(_facts())
    assert (answered["is_proven"], answered["drift"], answered["computer"]["cpus"]) == (True, (), 4)


def test_peers_behind_relays_show_the_way() -> None:
    routes = [
        {"name": "base", "via": ["husky2", "b07"], "in_use": True},
        {"name": "husky2", "via": ["base"], "in_use": False},
        {"name": 7, "via": "nonsense", "in_use": "yes"},
    ]
    status = json.dumps({**json.loads(_STATUS), "relaying": {"routes": routes}})
    facts = _facts(ANSWER.replace(_STATUS, status))
    assert {peer.name: peer.via for peer in facts.peers} == {"base": ("husky2", "b07"), "husky2": ()}
    assert facts_object(facts)["reached_through"] == ["base through husky2 and b07"]
    assert "husky1: reaches base through husky2 and b07" in table([facts], 80).splitlines()
    assert _facts().reached_through == ()


def test_drift_lists_inventory_differences_and_manual_changes() -> None:
    text = ANSWER.replace("wheel=9999", "wheel=7777").replace("== computer", "damaged=etc/udp-mesh.toml\n== computer")
    text = text.replace("file=2222", "file=3333").replace("UnitFileState=enabled", "UnitFileState=disabled")
    facts = _facts(text)
    assert facts.drift == (
        "changed on the robot: etc/udp-mesh.toml",
        "differs from the inventory: udp-mesh.service",
        "another version of udp-mesh than in this meshctl",
        "udp-mesh.service will not start at boot",
    )
    assert facts.is_healthy, "what runs is well, only not as the inventory says"
    assert "4 differ" in facts.remark


def test_a_robot_without_its_wanted_bridge_running_is_unhealthy() -> None:
    wanted = ExpectedRelease({**WANTED.files, "udp-mesh-ros1.service": "e" * 64}, WANTED.wheels)
    facts = _facts(wanted=wanted)
    assert facts.bridge is not None
    assert not facts.is_healthy
    assert "the ROS bridge is absent" in facts.remark
    bridge = _SERVICES.index("Id=udp-mesh-ros1")
    up = ANSWER[:bridge] + ANSWER[bridge:].replace("not-found", "loaded", 1).replace("inactive", "active", 1)
    up = up.replace("UnitFileState=\n", "UnitFileState=enabled\n")
    assert _facts(up, wanted).is_healthy
    assert _facts(up).bridge is not None, "an installed one is reported even if the inventory has none"


def test_a_daemon_that_does_not_answer_is_reported_as_unhealthy() -> None:
    silent = _facts(f"{_SERVICES}== status\n== topics\n")
    assert not silent.is_healthy
    assert silent.remark == "the daemon does not answer"
    assert "the daemon does not answer" in table([silent, _facts()])
    nothing = _facts("")
    assert not nothing.is_healthy
    assert nothing.drift == ("not installed",)
    assert "not installed" in nothing.remark
    away = RobotFacts("husky9", error="husky9 (10.42.0.19): no answer")
    assert "no answer" in table([away])


def test_the_table_shows_queues_by_priority_and_the_latest_message() -> None:
    output = table([_facts()])
    assert "p9: 3" in output
    assert "status 0 s ago" in output
    assert "1/2" in output


def test_a_narrow_terminal_lists_hidden_columns_and_keeps_every_error() -> None:
    away = RobotFacts("husky9", error="husky9 (10.42.0.19): no answer to connect within 5 s: is it on?")
    for width in (60, 80, 100, 200):
        lines = table([_facts(), away], width).splitlines()
        assert [line for line in lines if len(line) > width] == []
        assert "husky9: husky9 (10.42.0.19): no answer" in " ".join(lines)
        assert lines[0].split()[:2] == ["robot", "service"]
        assert ("columns not shown" in " ".join(lines)) == (width < 100)


PING = """#!/bin/sh
# answers for one address, the last argument
for address; do :; done
[ "$address" = 10.42.0.31 ]
"""


def facts_of_script(tmp_path: Path, *, has_ping: bool) -> RobotFacts:
    """What the real script prints here, with a `ping` of the test's own or none."""
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("sh", "cat", "date", "grep", "sed", "df", "awk", "dirname", "readlink", "basename"):
        found = shutil.which(name)
        assert found is not None
        (tools / name).symlink_to(found)
    if has_ping:
        (tools / "ping").write_text(PING, encoding="utf-8")
        (tools / "ping").chmod(0o755)
    words = ["sh", "-c", script("facts"), "facts", "10.42.0.31", "10.42.0.32"]
    done = subprocess.run(words, env={"PATH": str(tools)}, capture_output=True, text=True, check=False, timeout=60)
    return parse_robot_facts("husky1", done.stdout, WANTED, now_s=NOW_S)


def test_the_script_pings_the_other_computers_of_the_robot(tmp_path: Path) -> None:
    facts = facts_of_script(tmp_path, has_ping=True)
    assert facts.answering == ("10.42.0.31",)
    assert facts.computer.uptime_s is not None


def test_a_computer_without_ping_does_not_call_the_others_silent(tmp_path: Path) -> None:
    assert facts_of_script(tmp_path, has_ping=False).answering is None
