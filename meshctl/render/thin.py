"""A robot's thin links -> `[thin]` of its daemon's configuration."""

from __future__ import annotations

import json
from collections.abc import Iterator

from meshctl.model import Fleet, ThinFraming, ThinLink, Topic
from meshctl.model.thin import BURST_SHARE, MIN_FRAME_BYTES, URGENT_SHARE, WINDOW_S

# Speeds that Linux knows by name (termios.h), which the daemon accepts.
BAUD_RATES = (
    1200, 1800, 2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 500_000, 576_000, 921_600,
    1_000_000, 1_152_000, 1_500_000, 2_000_000, 2_500_000, 3_000_000, 3_500_000, 4_000_000,
)  # fmt: skip

Problem = tuple[tuple[str, ...], str, str]
"""Where, what is expected, what was found."""


def thin_problems(fleet: Fleet, robot: str) -> Iterator[Problem]:
    """Settings that the daemon would reject."""
    own = fleet.robots[robot].thin
    links = fleet.udp_mesh.thin_links
    for name in own.ports if own is not None else ():
        path = ("udp_mesh", "thin_links", name)
        if name not in links:
            yield ("robots", robot, "thin", "ports", name), "one of udp_mesh.thin_links", name
        elif links[name].baud not in BAUD_RATES:
            yield (*path, "baud"), "a standard speed (9600, 57600, 115200)", str(links[name].baud)
        else:
            for expected, found in frame_problems(links[name]):
                yield (*path, "frame_bytes"), expected, found
    for topic in fleet.topics:
        if topic.thin and (topic.compression or topic.delta or topic.log is not None):
            yield ("topics", topic.name, "thin"), "no compression, delta or log with thin", "true"


def frame_problems(link: ThinLink) -> Iterator[tuple[str, str]]:
    """A frame that is never allowed: (expected, found)."""
    if link.largest_frame_bytes < MIN_FRAME_BYTES:
        yield (
            f"frames of {MIN_FRAME_BYTES} B within the band's {link.band.dwell_s} s",
            f"{link.airtime_s(MIN_FRAME_BYTES):.2f} s at {link.bits_per_s:g} bit/s",
        )
        return
    room_s = (1 - URGENT_SHARE) * BURST_SHARE * link.allowed_duty_cycle * WINDOW_S
    airtime_s = link.airtime_s(link.largest_frame_bytes)
    if link.allowed_duty_cycle < 1 and airtime_s > room_s:
        yield f"frames of at most {room_s:.2f} s for this duty cycle", f"{airtime_s:.2f} s"


def thin_lines(fleet: Fleet, robot: str) -> Iterator[str]:
    """Nothing for a robot without ports: daemons of earlier versions reject unknown keys."""
    own = fleet.robots[robot].thin
    if own is None or not own.ports:
        return
    yield from ("", "[thin]", f"number = {own.number}", f"presence_s = {float(fleet.udp_mesh.thin_presence_s)!r}")
    for name, device in own.ports.items():
        link = fleet.udp_mesh.thin_links[name]
        yield from ("", "[[thin.links]]", f"name = {json.dumps(name)}", f"device = {json.dumps(device)}")
        if link.framing is not ThinFraming.COBS:
            yield f'framing = "{link.framing.value}"'
        if link.preset is not None:
            yield from (f'preset = "{link.preset.name}"', f"hop_limit = {link.hop_limit}")
        else:
            yield from (f"baud = {link.baud}", f"bits_per_s = {float(link.bits_per_s)!r}")
            yield f"frame_s = {float(link.frame_s)!r}"
        yield f"frame_bytes = {link.frame_bytes}"
        yield f"duty_cycle = {float(link.allowed_duty_cycle)!r}"
        if link.band.dwell_s is not None:
            yield f"max_airtime_s = {link.band.dwell_s!r}"


def thin_topic_lines(topic: Topic) -> Iterator[str]:
    """Keys of a topic that thin links carry; on every robot, so that each accepts it."""
    if topic.thin:
        yield "thin = true"
        if topic.thin_links:
            yield f"links = [{', '.join(map(json.dumps, topic.thin_links))}]"
        if topic.thin_period_s is not None:
            yield f"thin_period_s = {float(topic.thin_period_s)!r}"
