"""What must hold in a team of real daemons, whatever happens: `python -m tests.udp_mesh.daemon.live.promises 0 20`.

The live counterpart of `tests/udp_mesh/core/promises.py`. It needs a network and a mount namespace of its own, as root:
`unshare --net --mount`, which it enters by itself.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tests.udp_mesh.daemon.live.changes import NETWORK_CHANGES, ROBOT_CHANGES, change, start
from tests.udp_mesh.daemon.live.ether import Direction
from tests.udp_mesh.daemon.live.legacy import NAME as LEGACY
from tests.udp_mesh.daemon.live.legacy import TOPICS as LEGACY_TOPICS
from tests.udp_mesh.daemon.live.programs import Broken
from tests.udp_mesh.daemon.live.team import LiveTeam

AFTER_REPAIR = "repaired"
SMALL, LARGE = (60, 100, 100, 300, 1_380, 1_400), (1_420, 9_000, 60_000, 200_000)
SETTLE_S, LEAST_BYTES_PER_S = 120.0, 15_000
"""After the repair everything ends within this time even on a busy machine, and what waits at that rate."""
MAX_IDLE_TURNS_PER_S, MAX_IDLE_DATAGRAMS_PER_S = 100, 15
MAX_IDLE_LOAD = 0.15
"""Of a daemon whose turns are not counted."""
MAX_LOG_LINES = 2000
MAX_MEMORY_BYTES = 300 << 20


def repair(team: LiveTeam) -> None:
    """The network, daemons, disks and programs work."""
    for ether in team.ethers:
        for key in ether.paths:
            ether.paths[key] = Direction()
        ether.rate_bits_per_s = 20e6
        ether.outside_ports.clear()
    for name, robot in team.robots.items():
        robot.set_disk("rw")
        robot.free_disk()
        robot.refuse_none()
        robot.set_busy(False)
        robot.resume()
        for radio in robot.radios:
            radio.allow_to_send()
            radio.set_mtu(1500)
            radio.plug_in()
        start(team, name)
        # To readers of the log, also from where the disk was full.
        team.publish(name, "artifact", None, 100)
        if robot.reader is not None:
            robot.reader.paused_until = 0.0
    for robot in team.others:
        robot.end(politely=True)


def play(
    seed: int,
    seconds: float,
    size: int | None = None,
    version: Path | None = None,
    kinds: Sequence[str] = (),
) -> LiveTeam:
    """Messages and changes for so long, then none. `kinds` are those of changes, none: all. Raises Broken."""
    with LiveTeam(seed, size, version) as team:
        team.kinds = tuple(kinds)
        try:
            _play(team, seconds)
        except Exception:
            for name, robot in team.robots.items():
                sys.stderr.write(f"---- {name}\n{robot.daemon.log.read_text()[-6000:]}\n")
            sys.stderr.write("\n".join(team.changes[-60:]) + "\n")
            raise
        return team


def _play(team: LiveTeam, seconds: float) -> None:
    dice = team.dice
    team.go(10.0, until=lambda: all_online(team))
    topics = dice.sample(
        [
            "stop",
            "pose",
            "order",
            "status",
            "view",
            "kept",
            "newest",
            "stored",
            "limited",
            "map",
            "grid",
            "alert",
            "artifact",
        ],
        dice.randint(3, 13),
    )
    chance, pauses = dice.choice((0.05, 0.2)), dice.choice(((0.0, 0.02, 0.2), (0.05, 0.3)))
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        name, topic = dice.choice(team.names), dice.choice(topics)
        to = dice.choice([None, *(one for one in team.everyone if one != name)])
        if team.legacy is not None and dice.random() < 0.1:
            team.publish_legacy(dice.choice(LEGACY_TOPICS), to if to != LEGACY else None, dice.choice((*SMALL, 9_000)))
        if topic in ("artifact", "alert"):
            to = None
        for _ in range(dice.choice((1, 1, 1, 20))):
            team.publish(name, topic, to, dice.choice(LARGE if dice.random() < 0.15 else SMALL))
        if dice.random() < chance:
            change(team)
        team.go(dice.choice(pauses))
    repair(team)
    within_s = SETTLE_S + sum(sent.size for sent in team.unfinished()) / LEAST_BYTES_PER_S
    if not team.go(within_s, until=lambda: not team.unfinished()):
        left = team.unfinished()
        raise Broken(f"after {within_s:.0f} s {len(left)} messages have not ended: {[str(one) for one in left[:5]]}")
    if not team.go(within_s, until=lambda: not team.not_passed_on()):
        left = team.not_passed_on()
        raise Broken(f"{len(left)} messages were delivered, but not to the programs: {[str(one) for one in left[:5]]}")
    if not team.go(within_s, until=lambda: not team.lost_at_legacy()):
        left = team.lost_at_legacy()
        raise Broken(f"{len(left)} messages were delivered, but not to {LEGACY}: {[str(one) for one in left[:5]]}")
    if team.legacy is not None and not team.go(within_s, until=partial(is_heard, team)):
        raise Broken("the legacy robot is not heard by all")
    if not team.go(within_s, until=lambda: not team.missing_items()):
        raise Broken(f"items of the log are missing: {team.missing_items()[:5]}")
    if not team.go(within_s, until=lambda: all_online(team)):
        raise Broken(f"not all robots reach each other {within_s:.0f} s after the repair")
    # What comes late, and twice.
    team.go(2.0)
    check_finished(team)


def all_online(team: LiveTeam) -> bool:
    for name, robot in team.robots.items():
        assert robot.writer is not None
        peers = {peer["name"]: peer["online"] for peer in robot.writer.program.request("peers")["peers"]}
        if not all(peers.get(one) for one in team.everyone if one != name):
            return False
    return True


def is_heard(team: LiveTeam) -> bool:
    """Whether a message of the legacy robot has come to each other one after the repair. It drops what it has queued
    when something is unanswered for 10 s, so a new one is sent each time."""
    assert team.legacy is not None
    for name in team.names:
        team.publish_legacy(AFTER_REPAIR, name, 100)
    return all(any(team.sent[key].topic == AFTER_REPAIR for key in team.received[name]) for name in team.names)


def check_finished(team: LiveTeam) -> None:
    """Nothing is left over, the daemons are idle, and their logs are short."""
    if not team.go(SETTLE_S, until=lambda: not left_over(team)):
        raise Broken(f"left over: {left_over(team)}")
    # Readers of logs may still fetch items.
    end = time.monotonic() + SETTLE_S
    while (busy := what_is_busy(team)) and time.monotonic() < end:
        pass
    if busy:
        raise Broken(f"{busy} although nothing happens")
    for name, robot in team.robots.items():
        if (memory := robot.usage()[1]) > MAX_MEMORY_BYTES:
            raise Broken(f"{name} holds {memory >> 20} MiB")
        check_log(name, robot.daemon.log.read_text())


def what_is_busy(team: LiveTeam) -> list[str]:
    """Robots whose event loop or network is busy within the next seconds. Turns of the loop are counted because a loop
    without an end gets any share of the processors of a busy machine."""
    before = {name: (robot.usage()[0], robot.turns()) for name, robot in team.robots.items()}
    datagrams, began = count_datagrams(team), time.monotonic()
    team.go(3.0)
    took_s = time.monotonic() - began
    found = []
    for name, robot in team.robots.items():
        load_before, turns_before = before[name]
        load, turns = (robot.usage()[0] - load_before) / took_s, robot.turns()
        rate = (count_datagrams(team)[name] - datagrams[name]) / took_s
        if turns is None or turns_before is None:
            is_busy, what = load > MAX_IDLE_LOAD, f"uses {load:.2f} core"
        else:
            turns_per_s = (turns - turns_before) / took_s
            is_busy, what = turns_per_s > MAX_IDLE_TURNS_PER_S, f"wakes {turns_per_s:.0f} times a second"
        if is_busy or rate > MAX_IDLE_DATAGRAMS_PER_S * len(team.robots) * len(team.ethers):
            found.append(f"{name} {what} and sends {rate:.0f} datagrams a second")
    return found


def count_datagrams(team: LiveTeam) -> Counter[str]:
    return sum((ether.datagrams for ether in team.ethers), Counter[str]())


def left_over(team: LiveTeam) -> dict[str, object]:
    """By robot, bytes that it still has to send, files of messages, and why its log is not on disk."""
    found: dict[str, object] = {}
    for name, robot in team.robots.items():
        assert robot.writer is not None
        queued = robot.writer.program.request("status")["conditions"]["queued_bytes"]
        files = list((team.folder / f"{name}.disk").rglob("*.message"))
        disk = robot.writer.program.request("logs")["disk"]
        if queued or files or disk:
            found[name] = (queued, files[:3], disk)
    return found


def check_log(name: str, text: str) -> None:
    if "Traceback" in text or "exception" in text.lower():
        raise Broken(f"{name}: {text[-3000:]}")
    kinds = Counter(" ".join(line.split()[:2]) for line in text.splitlines())
    if kinds.total() > MAX_LOG_LINES:
        raise Broken(f"{name} logged {kinds.total()} lines: {kinds.most_common(5)}")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.udp_mesh.daemon.live.promises", description=__doc__)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--robots", type=int)
    parser.add_argument(
        "--version", type=Path, metavar="FOLDER", help="a checkout of another version, for one robot of each team"
    )
    parser.add_argument(
        "--only", nargs="+", default=(), choices=sorted({*NETWORK_CHANGES, *ROBOT_CHANGES}), help="kinds of changes"
    )
    arguments = parser.parse_args()
    if "LIVE_TEAM" not in os.environ:
        user = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
        os.environ["LIVE_TEAM"] = "1"
        os.execvp(
            "unshare", ["unshare", *user, "--net", "--mount", "--", sys.executable, "-m", __spec__.name, *sys.argv[1:]]
        )
    failed = 0
    for seed in range(arguments.first, arguments.last):
        try:
            team = play(seed, arguments.seconds, arguments.robots, arguments.version, arguments.only)
            worst = {topic: f"{sorted(found)[len(found) * 99 // 100]:.2f}" for topic, found in team.latencies.items()}
            robots = f"{len(team.everyone)} robots over {'IPv6' if team.ipv6 else 'IPv4'}"
            robots += f" and {len(team.ethers)} networks{', one with the legacy program' if team.legacy else ''}"
            sys.stdout.write(f"seed {seed}: {robots}, {len(team.sent)} sent, {dict(team.outcomes)}, p99 {worst}\n")
        except Exception as error:  # noqa: BLE001
            failed += 1
            sys.stdout.write(f"seed {seed}: FAILED {type(error).__name__}: {str(error)[:1500]}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{failed} of {arguments.last - arguments.first} seeds failed\n")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
