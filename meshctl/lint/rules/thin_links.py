"""Thin links: numbers, ports, the limits of their bands, and what topics offer on them (MC771 to MC781)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates
from meshctl.lint.places import first_written
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.references import suggest
from meshctl.model import Fleet, ThinBand, ThinLink, Topic
from meshctl.model.thin import BURST_SHARE, MAX_2400_MHZ_FRAME_BYTES, PART_OVERHEAD_BYTES
from meshctl.render.thin import frame_problems
from meshctl.wording import join_limited, two_digits


def _countries(text: str) -> frozenset[str]:
    return frozenset(text.split())


# Countries where a band is not free for such radios: America and Oceania have no 868 MHz band, CEPT (ERC/REC 70-03) has
# no 915 MHz band of this kind.
_AMERICA = _countries("AR AU BO BR CA CL CO CR EC GT MX NZ PA PE PR PY US UY VE")
_CEPT = _countries(
    "AT BE BG CH CY CZ DE DK EE ES FI FR GB GR HR HU IE IS IT LI LT LU LV MC MT NL NO PL PT RO SE SI SK TR UA"
)
_NOT_IN = {ThinBand.EU868: _AMERICA, ThinBand.EU869: _AMERICA, ThinBand.US915: _CEPT}

# Of a presence with some heard nodes; an acknowledgment in a frame of its own.
_PRESENCE_BYTES = 60
_ACK_BYTES = 12


@fleet_rule(
    "MC771",
    Severity.ERROR,
    "Two robots have the same number on thin links",
    why="""Frames of thin links name their sender by its number alone. Robots with one number replace each other at all
    receivers, and neither is heard for long.""",
    fix="Give each robot its own number from 1 to 254.",
    failing="robots: {base-station: {thin: {number: 1}}, husky1: {thin: {number: 1}}}",
    passing="robots: {base-station: {thin: {number: 1}}, husky1: {thin: {number: 2}}}",
)
def number_used_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    owners: dict[int, str] = {}
    for robot in fleet.robots.values():
        if robot.thin is None:
            continue
        other = owners.setdefault(robot.thin.number, robot.name)
        if other != robot.name:
            path = ("robots", robot.name, "thin", "number")
            yield Finding(path, f"{other} has this number, too", "a number of its own", str(robot.thin.number))


@fleet_rule(
    "MC772",
    Severity.ERROR,
    "A thin link is not defined",
    why="""A port for an unknown link is not opened, and a topic for an unknown link is sent on none: messages
    that should arrive where Wi-Fi does not reach are lost.""",
    fix="Use a link of `udp_mesh.thin_links`.",
    failing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}}}
    robots: {husky1: {thin: {number: 2, ports: {lroa: /dev/ttyUSB0}}}}
    """,
    passing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}}}
    robots:
      base-station: {thin: {number: 1, ports: {lora: /dev/ttyUSB0}}}
      husky1: {thin: {number: 2, ports: {lora: /dev/ttyUSB0}}}
    """,
)
def unknown_thin_link(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    known = tuple(fleet.udp_mesh.thin_links)
    owners = [robot.name for robot in fleet.robots.values() if robot.thin is not None and robot.thin.ports]
    if not known and len(owners) > 1:
        # the section is missing, rather than each port wrong
        path = first_written(fleet, ("udp_mesh",), ("robots", owners[0], "thin", "ports"))
        found = f"ports of {join_limited(owners)}"
        yield Finding(path, "no thin link is defined", "udp_mesh.thin_links", found)
        return
    for robot in fleet.robots.values():
        for name in robot.thin.ports if robot.thin is not None else ():
            if name not in known:
                expected, hint = suggest(known, name)
                yield Finding(("robots", robot.name, "thin", "ports", name), "no such thin link", expected, name, hint)
    for topic in fleet.topics:
        for index, name in enumerate(topic.thin_links):
            if name not in known:
                expected, hint = suggest(known, name)
                path = ("topics", topic.name, "thin_links", str(index))
                yield Finding(path, "no such thin link", expected, name, hint)


@fleet_rule(
    "MC773",
    Severity.ERROR,
    "A thin link may send more than its band allows",
    why="""The daemons send up to `duty_cycle` of every hour. EN 300 220-2 allows 1 % from 868.0 to 868.6 MHz and 10 %
    from 869.4 to 869.65 MHz, without listening before talking.""",
    fix="Remove `duty_cycle`, which defaults to the band's, or use a band that allows more.",
    failing=Example(
        "udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: eu868, duty_cycle: 0.1}}}", also=("MC781",)
    ),
    passing=Example(
        "udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: eu869, duty_cycle: 0.1}}}", also=("MC781",)
    ),
)
def duty_cycle_of_band(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, link in fleet.udp_mesh.thin_links.items():
        if link.allowed_duty_cycle > link.band.duty_cycle:
            path = ("udp_mesh", "thin_links", name, "duty_cycle")
            allowed = f"at most {link.band.duty_cycle:g}"
            yield Finding(path, f"above that of {link.band.value}", allowed, f"{link.allowed_duty_cycle:g}")


@fleet_rule(
    "MC774",
    Severity.ERROR,
    "A frame of a thin link takes longer than its band allows",
    why="""A hopping radio from 902 to 928 MHz may stay on a channel for 0.4 s (47 CFR 15.247), and a limited duty cycle
    leaves room for short frames only. The daemon would never send, and refuses the configuration.""",
    fix="Use a faster air rate (a lower spreading factor), or smaller frames.",
    failing="udp_mesh: {thin_links: {lora: {bits_per_s: 500, band: us915}}}",
    passing="udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}}}",
)
def frame_beyond_band(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, link in fleet.udp_mesh.thin_links.items():
        for expected, found in frame_problems(link):
            yield Finding(("udp_mesh", "thin_links", name), "frames cannot be sent", expected, found)


@fleet_rule(
    "MC775",
    Severity.WARNING,
    "Topics offer more than a thin link may send",
    why="""Presence, the messages that each robot sends on the link, and the acknowledgments of those that it receives
    need more airtime than the duty cycle allows in the long run. Less urgent messages then wait until they expire, and
    the link has nothing left when it is needed.""",
    fix="Mark fewer topics with `thin`, set `thin_period_s`, send smaller messages, or use a faster radio.",
    failing=Example(
        """
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: eu868}}}
    topics: {pose: {priority: 8, rate_hz: 10, size_bytes: 60, thin: true}}
    """,
        also=("MC781",),
    ),
    passing=Example(
        """
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: eu868}}}
    topics: {pose: {priority: 8, rate_hz: 10, size_bytes: 60, thin: true, thin_period_s: 60}}
    """,
        also=("MC781",),
    ),
)
def thin_overload(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, link in fleet.udp_mesh.thin_links.items():
        if any(frame_problems(link)):
            continue
        topics = [topic for topic in fleet.topics if _carries(name, topic) and topic.size_bytes <= _limit(topic, link)]
        share = link.airtime_s(_PRESENCE_BYTES) / fleet.udp_mesh.thin_presence_s
        share += sum(_airtime_share(topic, link) for topic in topics)
        allowed = (1 - BURST_SHARE) * link.allowed_duty_cycle
        if share > allowed:
            text = f"{', '.join(topic.name for topic in topics)} and presence"
            path = ("udp_mesh", "thin_links", name)
            expected = f"at most {two_digits(100 * allowed)} % of the time per robot"
            yield Finding(path, text, expected, f"{two_digits(100 * share)} %")


def _carries(name: str, topic: Topic) -> bool:
    return topic.thin and (not topic.thin_links or name in topic.thin_links)


def _limit(topic: Topic, link: ThinLink) -> int:
    """Largest payload of the topic on the link; the type name takes its length and its bytes."""
    return max(0, link.largest_message_bytes - 1 - len(topic.type_name.encode()))


def _airtime_share(topic: Topic, link: ThinLink) -> float:
    """Share of the time that a robot sends for a topic: its messages, or the acknowledgments of another's."""
    rate_hz = topic.sent_rate_hz if topic.thin_period_s is None else min(topic.sent_rate_hz, 1 / topic.thin_period_s)
    room = link.largest_frame_bytes - PART_OVERHEAD_BYTES
    body = topic.size_bytes + 1 + len(topic.type_name.encode())
    full, rest = divmod(body, room)
    airtime_s = full * link.airtime_s(link.largest_frame_bytes) + link.airtime_s(rest + PART_OVERHEAD_BYTES)
    return rate_hz * (airtime_s + link.airtime_s(_ACK_BYTES) * topic.reliable)


@fleet_rule(
    "MC776",
    Severity.ERROR,
    "A topic cannot be carried by a thin link",
    why="""A message on a thin link has at most 32 parts of one frame each, and is neither compressed nor sent as a
    difference nor an item of a log. Larger messages take the other links only; the daemon refuses a topic with such an
    option.""",
    fix="Send a smaller message (an artifact without its image), remove the option, or remove `thin`.",
    failing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915, frame_bytes: 64}}}
    topics: {report: {priority: 4, size_bytes: 20000, thin: true}}
    """,
    passing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915, frame_bytes: 64}}}
    topics: {report: {priority: 4, size_bytes: 200, thin: true}}
    """,
)
def topic_beyond_thin_links(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        if not topic.thin:
            continue
        options = {"compression": topic.compression, "delta": topic.delta, "log": topic.log is not None}
        for option, is_set in options.items():
            if is_set:
                path = ("topics", topic.name, option)
                yield Finding(path, "thin links do not have it", f"no {option} with thin", option)
        for name, link in fleet.udp_mesh.thin_links.items():
            if _carries(name, topic) and topic.size_bytes > _limit(topic, link):
                path = ("topics", topic.name, "size_bytes")
                expected = f"at most {_limit(topic, link)} B"
                yield Finding(path, f"too large for {name}", expected, f"{topic.size_bytes} B")


@fleet_rule(
    "MC777",
    Severity.WARNING,
    "Frames of a thin link are larger than its XBee radios take",
    why="""An XBee refuses payloads above its NP: 100 B at 2.4 GHz, 84 B with Zigbee, 73 B with DigiMesh, 256 B in some
    radios below 1 GHz. Broadcasts are not split. Short frames pass, so the link looks alive, and every longer message
    is lost.""",
    fix="Read NP with XCTU and set `frame_bytes` to it, or set the `band` of a radio below 1 GHz.",
    failing="udp_mesh: {thin_links: {xbee: {framing: xbee, bits_per_s: 250000, frame_bytes: 200}}}",
    passing="udp_mesh: {thin_links: {xbee: {framing: xbee, bits_per_s: 250000}}}",
)
def frame_beyond_xbee(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, link in fleet.udp_mesh.thin_links.items():
        # The bands that are known are those below 1 GHz.
        if not link.framing.is_xbee or link.band is not ThinBand.NONE:
            continue
        if link.frame_bytes > MAX_2400_MHZ_FRAME_BYTES:
            path = ("udp_mesh", "thin_links", name, "frame_bytes")
            expected = f"the radio's NP, at most {MAX_2400_MHZ_FRAME_BYTES} B at 2.4 GHz"
            yield Finding(path, "an XBee refuses larger payloads", expected, f"{link.frame_bytes} B")


@fleet_rule(
    "MC778",
    Severity.WARNING,
    "Only one robot is on a thin link",
    why="""No other robot hears it there, so beyond Wi-Fi neither its position nor an emergency stop arrives.
    Usually the base station's radio is missing in the inventory.""",
    fix="Add the port of another robot's radio (`thin.ports`), such as the base station's, or remove this one.",
    failing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}}}
    robots: {husky1: {thin: {number: 2, ports: {lora: /dev/ttyUSB0}}}}
    """,
    passing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}}}
    robots:
      base-station: {thin: {number: 1, ports: {lora: /dev/ttyUSB0}}}
      husky1: {thin: {number: 2, ports: {lora: /dev/ttyUSB0}}}
    """,
)
def robot_alone_on_thin_link(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    robots: dict[str, list[str]] = {}
    for robot in fleet.robots.values():
        for link in robot.thin.ports if robot.thin is not None else ():
            robots.setdefault(link, []).append(robot.name)
    for link, names in robots.items():
        if len(names) == 1 and link in fleet.udp_mesh.thin_links:
            path = ("robots", names[0], "thin", "ports", link)
            yield Finding(path, "no other robot is on this link", "at least two robots", f"{names[0]} alone")


@fleet_rule(
    "MC779",
    Severity.ERROR,
    "Two thin links of a robot have one serial port",
    why="""The daemon reads and writes two links through one radio: the bytes of both are mixed, and neither carries a
    message.""",
    fix="Give each link the port of its own radio, best by its name in /dev/serial/by-id.",
    failing=Example(
        """
        udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}, far: {bits_per_s: 5470, band: us915}}}
        robots:
          base-station: {thin: {number: 1, ports: {lora: /dev/ttyUSB0, far: /dev/ttyUSB0}}}
          husky1: {thin: {number: 2, ports: {lora: /dev/ttyUSB0, far: /dev/ttyUSB1}}}
        """
    ),
    passing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}, far: {bits_per_s: 5470, band: us915}}}
    robots:
      base-station: {thin: {number: 1, ports: {lora: /dev/ttyUSB0, far: /dev/ttyUSB1}}}
      husky1: {thin: {number: 2, ports: {lora: /dev/ttyUSB0, far: /dev/ttyUSB1}}}
    """,
)
def serial_port_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        ports = robot.thin.ports if robot.thin is not None else {}
        for port, (first, *later) in duplicates((str(port), link) for link, port in ports.items()):
            for link in later:
                path = ("robots", robot.name, "thin", "ports", link)
                yield Finding(path, f"{first} has the same port", "a port of its own", port)


@fleet_rule(
    "MC780",
    Severity.ERROR,
    "A robot's name does not fit the frames of its thin link",
    why="""A robot introduces itself on a thin link with its name in one frame. The daemon refuses a name that does not
    fit, and does not start.""",
    fix="Choose a shorter name, larger frames (`frame_bytes`), or a faster air rate where a band limits them.",
    failing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915, frame_bytes: 40}}}
    nodes: {rescue: {role: robot, state: carried, address: 10.42.0.12, label: R1}}
    robots:
      base-station: {thin: {number: 1, ports: {lora: /dev/ttyUSB0}}}
      search-and-rescue: {nodes: [rescue], thin: {number: 2, ports: {lora: /dev/ttyUSB0}}}
    """,
    passing="""
    udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915, frame_bytes: 60}}}
    nodes: {rescue: {role: robot, state: carried, address: 10.42.0.12, label: R1}}
    robots:
      base-station: {thin: {number: 1, ports: {lora: /dev/ttyUSB0}}}
      search-and-rescue: {nodes: [rescue], thin: {number: 2, ports: {lora: /dev/ttyUSB0}}}
    """,
)
def name_beyond_frame(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    links = fleet.udp_mesh.thin_links
    for robot in fleet.robots.values():
        ports = robot.thin.ports if robot.thin is not None else ()
        for name in ports:
            if name not in links or any(frame_problems(links[name])):
                continue
            length, limit = len(robot.name.encode()), links[name].longest_name_bytes
            if length > limit:
                text = f"frames of {name} have {links[name].largest_frame_bytes} bytes"
                yield Finding(("robots", robot.name), text, f"a name of at most {limit} bytes", f"{length} bytes")


@fleet_rule(
    "MC781",
    Severity.WARNING,
    "A thin link's band is not free in the country",
    why="""The radios transmit where the band belongs to others: 868 MHz is for unlicensed radios in Europe, 902 to
    928 MHz in America and Oceania. The limits that the daemon keeps are then the wrong ones.""",
    fix="Set `band` to that of the radios in your country: eu868 or eu869 in Europe, us915 in America.",
    failing="udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: eu868}}}",
    passing="udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: us915}}}",
)
def band_of_another_region(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for name, link in fleet.udp_mesh.thin_links.items():
        if fleet.country in _NOT_IN.get(link.band, ()):
            path = ("udp_mesh", "thin_links", name, "band")
            others = [band.value for band, countries in _NOT_IN.items() if fleet.country not in countries]
            yield Finding(path, f"not for radios in {fleet.country}", " or ".join(others), link.band.value)
