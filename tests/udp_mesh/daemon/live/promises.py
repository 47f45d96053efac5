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

from tests.udp_mesh.daemon.live.ether import PORT, Direction
from tests.udp_mesh.daemon.live.programs import Broken
from tests.udp_mesh.daemon.live.team import LiveTeam

NETWORK_CHANGES = (
    *("down", "one-way", "loss", "jitter", "damage", "mtu", "rate", "heal"),
    *("nat", "replay", "forge", "icmp"),
)
ROBOT_CHANGES = (
    *("kill", "leave", "suspend", "disk", "reader", "pause", "writer"),
    *("move", "unplug", "renumber", "refuse", "reload", "stranger", "twin", "second", "read-only", "clock", "link-mtu"),
    "no-buffers",
)
SMALL, LARGE = (60, 100, 100, 300, 1_380, 1_400), (1_420, 9_000, 60_000, 200_000)
SETTLE_S, LEAST_BYTES_PER_S = 120.0, 15_000
"""After the repair everything ends within this time even on a busy machine, and what waits at that rate."""
MAX_IDLE_LOAD, MAX_IDLE_DATAGRAMS_PER_S = 0.15, 15
MAX_LOG_LINES = 2000
MAX_MEMORY_BYTES = 300 << 20


def change(team: LiveTeam) -> None:
    """One random change."""
    name = team.dice.choice(team.names)
    other = team.dice.choice([one for one in team.names if one != name])
    kind = team.dice.choice(team.kinds or NETWORK_CHANGES + ROBOT_CHANGES)
    team.changes.append(f"{time.monotonic():.2f} {kind} {name} {other}")
    if kind in NETWORK_CHANGES:
        change_network(team, kind, name, other)
    else:
        change_robot(team, kind, name)


def change_network(team: LiveTeam, kind: str, name: str, other: str) -> None:
    """What happens on the way from one robot to the other."""
    dice, ether = team.dice, team.ether
    path, back = ether.paths[name, other], ether.paths[other, name]
    match kind:
        case "down":
            path.up = back.up = False
            team.later(dice.uniform(0.1, dice.choice((1.0, 5.0, 12.0))), partial(set_up, path, back))
        case "one-way":
            path.loss = dice.choice((0.0, 0.5, 1.0))
        case "loss":
            path.loss = back.loss = dice.choice((0.0, 0.02, 0.2, 0.5))
        case "jitter":
            path.jitter_s, path.duplicates = dice.choice((0.0, 0.005, 0.1)), dice.choice((0.0, 0.02, 0.3))
            path.delay_s = dice.choice((0.0005, 0.01, 0.15))
        case "damage":
            path.damage = dice.choice((0.0, 0.01, 0.2))
        case "mtu":
            path.mtu = dice.choice((1500, 1300, 1000, 700, 576))
        case "rate":
            ether.rate_bits_per_s = dice.choice((1e6, 5e6, 20e6))
        case "heal":
            ether.paths[name, other], ether.paths[other, name] = Direction(), Direction()
        case "nat":
            if dice.random() < 0.3:
                ether.outside_ports.pop(name, None)
            else:
                ether.outside_ports[name] = dice.choice((PORT + 1, 20_000, 61_000))
        case "replay":
            ether.replay(dice.choice((5, 100)))
        case "forge":
            stranger = "fe80::7:9" if team.ipv6 else "10.7.200.9"
            host = dice.choice([team.robots[name].address.split("/")[0], stranger])
            ether.replay(dice.choice((5, 100)), source=(host, dice.choice((PORT, 9999))))

        case "icmp":
            # Errors about datagrams that this robot sent, true or forged: a datagram tells nothing of its path but by
            # its answer. After "fragmentation needed" the kernel sends to that address in fragments of that size.
            team.ether.too_long |= {(name, one) for one in team.names}
            for _ in range(dice.choice((1, 20))):
                team.later(dice.random(), partial(ether.send_icmp_errors, name, dice.choice((1, 50))))


def set_up(*paths: Direction) -> None:
    for path in paths:
        path.up = True


def change_robot(team: LiveTeam, kind: str, name: str) -> None:
    """What happens on a robot, or to its team."""
    dice, robot = team.dice, team.robots[name]
    match kind:
        case "kill" | "leave":
            if robot.daemon.process is not None:
                team.end(name, politely=kind == "leave")
                team.later(dice.choice((0.0, 1.0, 4.0, 10.0)), partial(start, team, name))
        case "suspend":
            if robot.running:
                robot.suspend()
                team.later(dice.choice((0.3, 2.0, 5.0, 12.0)), robot.resume)
        case "disk":
            team.disk_trouble.add(name)
            robot.fill_disk()
            team.later(dice.choice((0.5, 5.0)), robot.free_disk)
        case "reader":
            team.close_reader(name)
            team.later(dice.choice((0.0, 0.3, 4.0)), partial(team.open_reader, name))
        case "pause":
            if robot.reader is not None:
                robot.reader.paused_until = time.monotonic() + dice.choice((0.3, 3.0))
        case "writer":
            team.close_writer(name)
            team.open_writer(name)
        case "move":
            robot.move(dice.randrange(1, 250) + 256 * (robot.place + 1), overlaps=dice.random() < 0.5)
        case "unplug":
            robot.ip("link set mesh0 down")
            team.later(dice.choice((0.0, 0.5, 5.0)), robot.plug_in)
        case "renumber":
            robot.unplug(dice.randrange(1, 250) + 256 * (robot.place + 1))
            team.later(dice.choice((0.0, 0.5, 5.0)), robot.plug_in)
        case "refuse":
            robot.refuse_to_send(dice.choice(("prohibit", "unreachable", "blackhole")))
            team.later(dice.choice((0.2, 2.0, 8.0)), robot.allow_to_send)
        case "no-buffers":
            robot.refuse_some(dice.choice(("ENOBUFS", "EAGAIN", "ENOBUFS EAGAIN EPERM", "ENETDOWN ENOMEM")))
            team.later(dice.choice((0.2, 2.0, 8.0)), robot.refuse_none)
        case "second":
            if robot.running and dice.random() < 0.3:
                robot.start_second()
        case "read-only":
            if robot.daemon.process is not None:
                team.disk_trouble.add(name)
                team.end(name, politely=dice.random() < 0.5)
                robot.set_disk("ro")
                team.later(dice.choice((0.0, 3.0)), partial(start, team, name))
                team.later(dice.choice((1.0, 8.0)), partial(robot.set_disk, "rw"))
        case "link-mtu":
            # IPv6 needs 1280. Larger datagrams of others do not arrive.
            team.ether.too_long |= {(one, name) for one in team.names}
            robot.ip(f"link set mesh0 mtu {dice.choice((1500, 1400, 1280) if team.ipv6 else (1500, 1300, 700, 576))}")
        case "clock":
            robot.set_clock(dice.choice((-1e9, -3600.0, -0.5, 0.0, 0.05, 1.0, 3600.0, 1e8)))
        case "reload":
            if robot.running:
                robot.daemon.write(robot.configuration(team.folder, dice.choice((0, 5, 12))))
                if robot.writer is not None:
                    robot.writer.program.post("reload")
        case "stranger":
            if not team.others:
                team.add_stranger()
        case "twin":
            if not team.contested and dice.random() < 0.3:
                twin = team.add_twin(name)
                team.later(dice.choice((2.0, 8.0)), partial(twin.end, politely=dice.random() < 0.5))


def start(team: LiveTeam, name: str) -> None:
    team.robots[name].start()
    team.open_reader(name)
    team.open_writer(name)


def repair(team: LiveTeam) -> None:
    """The network, daemons, disks and programs work."""
    ether = team.ether
    for key in ether.paths:
        ether.paths[key] = Direction()
    ether.rate_bits_per_s = 20e6
    ether.outside_ports.clear()
    for name, robot in team.robots.items():
        robot.set_disk("rw")
        robot.free_disk()
        robot.allow_to_send()
        robot.refuse_none()
        robot.resume()
        robot.ip("link set mesh0 mtu 1500")
        robot.plug_in()
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
        to = dice.choice([None, *(one for one in team.names if one != name)])
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
        if not all(peers.get(one) for one in team.names if one != name):
            return False
    return True


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
    """Robots that use the processor or the network within the next seconds."""
    before = {name: robot.usage()[0] for name, robot in team.robots.items()}
    datagrams, began = Counter(team.ether.datagrams), time.monotonic()
    team.go(3.0)
    took_s = time.monotonic() - began
    found = []
    for name, robot in team.robots.items():
        load = (robot.usage()[0] - before[name]) / took_s
        rate = (team.ether.datagrams[name] - datagrams[name]) / took_s
        if load > MAX_IDLE_LOAD or rate > MAX_IDLE_DATAGRAMS_PER_S * len(team.robots):
            found.append(f"{name} uses {load:.2f} core and sends {rate:.0f} datagrams a second")
    return found


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
            robots = f"{len(team.names)} robots over {'IPv6' if team.ipv6 else 'IPv4'}"
            sys.stdout.write(f"seed {seed}: {robots}, {len(team.sent)} sent, {dict(team.outcomes)}, p99 {worst}\n")
        except Exception as error:  # noqa: BLE001
            failed += 1
            sys.stdout.write(f"seed {seed}: FAILED {type(error).__name__}: {str(error)[:1500]}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{failed} of {arguments.last - arguments.first} seeds failed\n")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
