"""What happens to a live team: one random change of its networks or of its robots."""

from __future__ import annotations

import time
from functools import partial

from tests.udp_mesh.daemon.live.ether import PORT, Direction, Ether
from tests.udp_mesh.daemon.live.legacy import NAME as LEGACY
from tests.udp_mesh.daemon.live.team import LiveTeam

NETWORK_CHANGES = (
    *("down", "one-way", "loss", "jitter", "damage", "mtu", "rate", "heal"),
    *("nat", "replay", "forge", "icmp"),
)
ROBOT_CHANGES = (
    *("kill", "leave", "suspend", "disk", "reader", "pause", "writer"),
    *("move", "unplug", "renumber", "refuse", "reload", "stranger", "twin", "second", "read-only", "clock", "link-mtu"),
    *("no-buffers", "radio", "busy"),
)
LEGACY_CHANGES = ("down", "one-way", "loss", "jitter", "heal", "restart")
"""Of the way to the legacy robot, and of that."""


def change(team: LiveTeam) -> None:
    """One random change."""
    name = team.dice.choice(team.names)
    if team.legacy is not None and not team.kinds and team.dice.random() < 0.2:
        kind = team.dice.choice(LEGACY_CHANGES)
        team.changes.append(f"{time.monotonic():.2f} {kind} {name} {LEGACY}")
        if kind == "restart":
            team.legacy.restart()
        else:
            change_network(team, team.ethers[0], kind, *team.dice.sample((name, LEGACY), 2))
        return
    other = team.dice.choice([one for one in team.names if one != name])
    kind = team.dice.choice(team.kinds or NETWORK_CHANGES + ROBOT_CHANGES)
    team.changes.append(f"{time.monotonic():.2f} {kind} {name} {other}")
    if kind in NETWORK_CHANGES:
        change_network(team, team.dice.choice(team.ethers), kind, name, other)
    else:
        change_robot(team, kind, name)


def change_network(team: LiveTeam, ether: Ether, kind: str, name: str, other: str) -> None:
    """What happens on the way from one robot to the other."""
    dice = team.dice
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
            radio = team.robots[name].radios[team.ethers.index(ether)]
            host = dice.choice([radio.address.split("/")[0], stranger])
            ether.replay(dice.choice((5, 100)), source=(host, dice.choice((PORT, 9999))))
        case "icmp":
            # Errors about datagrams that this robot sent, true or forged: a datagram tells nothing of its path but by
            # its answer. After "fragmentation needed" the kernel sends to that address in fragments of that size.
            ether.too_long |= {(name, one) for one in team.names}
            for _ in range(dice.choice((1, 20))):
                team.later(dice.random(), partial(ether.send_icmp_errors, name, dice.choice((1, 50))))


def set_up(*paths: Direction) -> None:
    for path in paths:
        path.up = True


def change_robot(team: LiveTeam, kind: str, name: str) -> None:
    """What happens on a robot, or to its team."""
    dice, robot = team.dice, team.robots[name]
    radio = dice.choice(robot.radios)
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
        case "busy":
            robot.set_busy(True)
            team.later(dice.choice((1.0, 4.0)), partial(robot.set_busy, False))
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
            radio.move(dice.randrange(1, 250) + 256 * (robot.place + 1), overlaps=dice.random() < 0.5)
        case "unplug":
            radio.pull_out()
            team.later(dice.choice((0.0, 0.5, 5.0)), radio.plug_in)
        case "renumber":
            radio.renumber(dice.randrange(1, 250) + 256 * (robot.place + 1))
            team.later(dice.choice((0.0, 0.5, 5.0)), radio.plug_in)
        case "radio":
            # Its interface stays up, and nothing passes.
            ways = [way for ends, way in radio.ether.paths.items() if name in ends]
            for way in ways:
                way.up = False
            team.later(dice.choice((0.5, 3.0, 12.0)), partial(set_up, *ways))
        case "refuse":
            radio.allow_to_send()
            radio.refuse_to_send(dice.choice(("prohibit", "unreachable", "blackhole")))
            team.later(dice.choice((0.2, 2.0, 8.0)), radio.allow_to_send)
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
            radio.ether.too_long |= {(one, name) for one in team.names}
            radio.set_mtu(dice.choice((1500, 1400, 1280) if team.ipv6 else (1500, 1300, 700, 576)))
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
