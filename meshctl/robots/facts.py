"""The state of one robot, in one round trip: `scripts/facts.sh` -> sections -> `RobotFacts`.

`collect_facts` queries a robot, `parse_robot_facts` parses the reply and compares it with the desired
release, `facts_object` is its JSON. Ages are measured by the robot's monotonic clock; its wall clock is not trusted.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from meshctl.robots.bundle import BRIDGE_UNIT_NAME, HOSTS_UNIT_NAME, OPTIONAL_UNITS, UNIT_NAME
from meshctl.robots.collector_release import COLLECTOR_UNIT_NAME
from meshctl.robots.expected_release import ExpectedRelease
from meshctl.robots.host import Host
from meshctl.robots.position_facts import PositionFacts, positions_in

# Two Python programs start and answer, possibly on a small, busy ARM board.
FACTS_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True)
class ServiceFacts:
    """A systemd unit: `active` is `active`, `activating`, `failed` or `inactive`; `enabled` is empty for a unit that is
    not installed; `restarts` counts automatic restarts."""

    active: str = ""
    enabled: str = ""
    restarts: int = 0
    result: str = ""

    @property
    def is_up(self) -> bool:
        return self.active == "active"


@dataclass(frozen=True, slots=True)
class PeerFacts:
    """A peer as this robot sees it; times in seconds, None if unknown."""

    name: str
    online: bool
    heard_ago_s: float | None = None
    round_trip_s: float | None = None
    loss: float = 0.0
    outbox_messages: int = 0
    outbox_bytes: int = 0
    capacity_bits_per_s: float | None = None
    """The link's estimated capacity for payload; None if too little was sent to measure it."""
    delivered_bits_per_s: float | None = None
    via: tuple[str, ...] = ()
    """The relays on the way to it, the nearest first; empty if it is reached directly."""


@dataclass(frozen=True, slots=True)
class QueueFacts:
    """The queue of one priority over all peers; `oldest_s` is the age of the oldest message."""

    priority: int
    messages: int
    bytes: int
    oldest_s: float


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """One topic at this daemon; `priority` is None for a topic that is only received. Ages are None before the first
    message, and for older daemons."""

    name: str
    priority: int | None
    sent_messages: int = 0
    received_messages: int = 0
    sent_ago_s: float | None = None
    received_ago_s: float | None = None

    @property
    def last_ago_s(self) -> float | None:
        """Time since the last message in either direction."""
        return min((age for age in (self.sent_ago_s, self.received_ago_s) if age is not None), default=None)


@dataclass(frozen=True, slots=True)
class ComputerFacts:
    """The computer itself. `load` is the average over 1, 5 and 15 minutes; `clock_ahead_s` is its clock minus ours,
    latency included."""

    uptime_s: float | None = None
    load: tuple[float, float, float] | None = None
    cpus: int = 0
    memory_kib: int = 0
    memory_free_kib: int = 0
    disk_kib: int = 0
    disk_free_kib: int = 0
    clock_ahead_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RobotFacts:
    """One robot at `seen_s` (our clock, Unix time).

    `error` is why the computer could not be queried; all else is empty then. `drift` has one line per difference from
    the inventory. `bridge`, `hosts` (the service for /etc/hosts) and `collector` are None if neither expected nor
    installed.
    `answering` are the pinged addresses that answered (None: it has no ping). `status` is the output of `udp-mesh
    status --json`, empty if the daemon does not answer.
    """

    robot: str
    seen_s: float = 0.0
    error: str = ""
    service: ServiceFacts = ServiceFacts()
    bridge: ServiceFacts | None = None
    hosts: ServiceFacts | None = None
    collector: ServiceFacts | None = None
    release: str = ""
    previous: str = ""
    is_proven: bool = True
    drift: tuple[str, ...] = ()
    version: str = ""
    daemon_uptime_s: float | None = None
    keys: tuple[str, ...] = ()
    unkeyed: bool = False
    peers: tuple[PeerFacts, ...] = ()
    positions: tuple[PositionFacts, ...] = ()
    """Of this robot and of its peers, as its daemon knows them; empty for older daemons."""
    queues: tuple[QueueFacts, ...] = ()
    topics: tuple[TopicFacts, ...] = ()
    computer: ComputerFacts = ComputerFacts()
    answering: tuple[str, ...] | None = None
    status: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def answers(self) -> bool:
        """Whether the daemon answered."""
        return bool(self.status)

    @property
    def collector_problem(self) -> str:
        """Why the radios give the collector no new values; empty if they do."""
        radio = _within(_within(self.status, "conditions"), "radio")
        return str(radio.get("problem") or "")

    @property
    def online(self) -> tuple[str, ...]:
        return tuple(peer.name for peer in self.peers if peer.online)

    @property
    def is_installed(self) -> bool:
        """Whether udp_mesh is."""
        return bool(self.release or self.service.enabled)

    @property
    def reached_through(self) -> tuple[str, ...]:
        """The peers reached through relays, one text each: `uav1 through husky1`."""
        relayed = (peer for peer in self.peers if peer.online and peer.via)
        return tuple(f"{peer.name} through {' and '.join(peer.via)}" for peer in relayed)

    @property
    def is_healthy(self) -> bool:
        """Whether all expected services run and are proven; drift does not count."""
        others = (service for service in (self.bridge, self.hosts, self.collector) if service is not None)
        services_are_up = self.service.is_up and all(service.is_up for service in others)
        return not self.error and services_are_up and self.is_proven and self.answers

    @property
    def remark(self) -> str:
        """The problems, in one line; empty if there are none."""
        if self.error:
            return self.error
        if not self.is_installed:
            return "not installed: run `meshctl robots deploy`"
        problems = []
        if not self.is_proven:
            problems.append("a switch was interrupted: deploy again")
        if self.service.is_up and not self.answers:
            problems.append("the daemon does not answer")
        others = {"ROS bridge": self.bridge, "service for /etc/hosts": self.hosts, "collector": self.collector}
        down = {name: other for name, other in others.items() if other is not None and not other.is_up}
        problems += [f"the {name} is {service.active or 'absent'}" for name, service in down.items()]
        problems += [f"{count} differ from the inventory" for count in [len(self.drift)] if count]
        away = [peer.name for peer in self.peers if not peer.online]
        problems += [f"offline peers: {', '.join(away)}"] if away else []
        return "; ".join(problems)


def collect_facts(
    host: Host, robot: str, expected: ExpectedRelease, *, now_s: float, others: Iterable[str] = ()
) -> RobotFacts:
    """Query one robot, which pings `others`; `now_s` is our clock (Unix time). Raises what `Host.run` raises."""
    return parse_robot_facts(robot, host.run("facts", *others, timeout_s=FACTS_TIMEOUT_S), expected, now_s=now_s)


def parse_robot_facts(robot: str, text: str, expected: ExpectedRelease, *, now_s: float) -> RobotFacts:
    """Parse the sections of `scripts/facts.sh`; a missing section or invalid JSON counts as no answer."""
    sections = _sections(text)
    services = _services(sections.get("services", ()))
    release, others = (_values(sections.get(name, ())) for name in ("release", "others"))
    status = _object(sections.get("status", ()))
    peers = tuple(_objects(_within(status, "conditions").get("peers")))
    routes = _objects(_within(status, "relaying").get("routes"))
    relayed = {str(route.get("name", "")): route for route in routes if route.get("in_use") is True}

    def optional(unit: str) -> ServiceFacts | None:
        found = services.get(unit, ServiceFacts())
        return found if unit in expected.units or found.enabled else None

    return RobotFacts(
        robot,
        seen_s=now_s,
        service=services.get(UNIT_NAME, ServiceFacts()),
        bridge=optional(BRIDGE_UNIT_NAME),
        hosts=optional(HOSTS_UNIT_NAME),
        collector=optional(COLLECTOR_UNIT_NAME),
        release=_last(release, "current"),
        previous=_last(release, "previous"),
        is_proven=_last(release, "proven") != "no",
        drift=drift(release, expected, services),
        version=str(status.get("version", "")),
        daemon_uptime_s=_float(status.get("uptime_s")),
        keys=tuple(str(key) for key in status.get("keys", ()) or ()),
        unkeyed=bool(status.get("unkeyed")),
        peers=tuple(_peer(peer, relayed) for peer in peers),
        positions=positions_in(status),
        queues=_queues(peers),
        topics=tuple(_topic(topic) for topic in _objects(_object(sections.get("topics", ())).get("topics"))),
        computer=_computer(_values(sections.get("computer", ())), now_s),
        answering=None if "ping" in others else tuple(others.get("answers", ())),
        status=status,
    )


def drift(
    release: Mapping[str, list[str]], expected: ExpectedRelease, services: Mapping[str, ServiceFacts]
) -> tuple[str, ...]:
    """One line per difference between the installed release and the inventory, or the release as deployed."""
    if not _last(release, "current"):
        return ("not installed",)
    here = {path: digest for digest, _, path in (row.partition("  ") for row in release.get("file", ()))}
    lines = [f"changed on the robot: {path}" for path in release.get("damaged", ())]
    lines += [f"differs from the inventory: {path}" for path, sha in expected.files.items() if here.get(path) != sha]
    lines += [f"not in the inventory: {unit}" for unit in OPTIONAL_UNITS if unit in here and unit not in expected.units]
    wheels = {row.split()[0] for row in release.get("wheel", ()) if row.strip()}
    lines += [
        f"another version of {name} than in this meshctl" for name, sha in expected.wheels.items() if sha not in wheels
    ]
    for unit in expected.units:
        if services.get(unit, ServiceFacts()).enabled != "enabled":
            lines.append(f"{unit} will not start at boot")
    return tuple(lines)


def facts_object(facts: RobotFacts) -> dict[str, Any]:
    """As JSON: every field by name, and the derived values; null is unknown, such as all of a silent computer."""
    unknown = ("seen_s", "is_proven", "unkeyed", "drift", "service") if facts.error else ()
    fields = {**dataclasses.asdict(facts), **dict.fromkeys(unknown)}
    if facts.computer == ComputerFacts():
        fields["computer"] = dict.fromkeys(fields["computer"])
    derived = {"well": facts.is_healthy, "answers": facts.answers, "online": list(facts.online), "remark": facts.remark}
    return {**fields, **derived, "reached_through": list(facts.reached_through)}


def _sections(text: str) -> dict[str, list[str]]:
    sections: dict[str, list[str]] = {}
    name = ""
    for line in text.splitlines():
        if line.startswith("== "):
            name = line.removeprefix("== ")
            sections.setdefault(name, [])
        else:
            sections.setdefault(name, []).append(line)
    return sections


def _values(lines: Iterable[str]) -> dict[str, list[str]]:
    values: dict[str, list[str]] = {}
    for line in lines:
        name, equals, value = line.partition("=")
        if equals:
            values.setdefault(name, []).append(value)
    return values


def _last(values: Mapping[str, list[str]], name: str) -> str:
    return values.get(name, [""])[-1]


def _services(lines: Iterable[str]) -> dict[str, ServiceFacts]:
    """Parse `systemctl show`: one property per line, units separated by an empty line."""
    found = {}
    unit: dict[str, str] = {}
    for line in (*lines, ""):
        name, equals, value = line.partition("=")
        if equals:
            unit[name] = value
        elif unit:
            found[unit.get("Id", "")] = ServiceFacts(
                # systemd reports an unknown unit as inactive, with an empty UnitFileState
                "" if unit.get("LoadState") == "not-found" else unit.get("ActiveState", ""),
                unit.get("UnitFileState", ""),
                int(_number(unit.get("NRestarts", "")) or 0),
                unit.get("Result", ""),
            )
            unit = {}
    return found


def _object(lines: Iterable[str]) -> dict[str, Any]:
    try:
        value = json.loads("\n".join(lines))
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def _within(value: Mapping[str, Any], name: str) -> dict[str, Any]:
    inner = value.get(name)
    return inner if isinstance(inner, dict) else {}


def _objects(value: object) -> list[dict[str, Any]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def _number(text: str) -> float | None:
    return float(text) if re.fullmatch(r"-?\d+(\.\d+)?", text) else None


def _float(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _peer(peer: Mapping[str, Any], relayed: Mapping[str, Mapping[str, Any]]) -> PeerFacts:
    via = relayed.get(str(peer.get("name", "")), {}).get("via")
    return PeerFacts(
        str(peer.get("name", "")),
        bool(peer.get("online")),
        _float(peer.get("heard_ago_s")),
        _float(peer.get("round_trip_s")),
        _float(peer.get("loss")) or 0.0,
        int(_float(peer.get("outbox_messages")) or 0),
        int(_float(peer.get("outbox_bytes")) or 0),
        _float(peer.get("capacity_bits_per_s")),
        _float(peer.get("delivered_bits_per_s")),
        tuple(str(relay) for relay in via) if isinstance(via, list) else (),
    )


def _queues(peers: Iterable[Mapping[str, Any]]) -> tuple[QueueFacts, ...]:
    levels: dict[int, QueueFacts] = {}
    for queue in (queue for peer in peers for queue in _objects(peer.get("queues"))):
        level = int(_float(queue.get("priority")) or 0)
        sum_so_far = levels.get(level, QueueFacts(level, 0, 0, 0.0))
        levels[level] = QueueFacts(
            level,
            sum_so_far.messages + int(_float(queue.get("messages")) or 0),
            sum_so_far.bytes + int(_float(queue.get("bytes")) or 0),
            max(sum_so_far.oldest_s, _float(queue.get("oldest_s")) or 0.0),
        )
    return tuple(levels[level] for level in sorted(levels))


def _topic(topic: Mapping[str, Any]) -> TopicFacts:
    priority = _float(topic.get("priority"))
    return TopicFacts(
        str(topic.get("name", "")),
        None if priority is None else int(priority),
        int(_float(topic.get("sent_messages")) or 0),
        int(_float(topic.get("received_messages")) or 0),
        _float(topic.get("sent_ago_s")),
        _float(topic.get("received_ago_s")),
    )


def _computer(values: Mapping[str, list[str]], now_s: float) -> ComputerFacts:
    def numbers(name: str) -> list[float]:
        return [number for word in _last(values, name).split() if (number := _number(word)) is not None]

    def number_at(name: str, at: int = 0) -> float:
        found = numbers(name)
        return found[at] if len(found) > at else 0.0

    load = numbers("load")
    return ComputerFacts(
        number_at("uptime") if numbers("uptime") else None,
        (load[0], load[1], load[2]) if len(load) >= 3 else None,
        int(number_at("cpus")),
        int(number_at("MemTotal")),
        int(number_at("MemAvailable")),
        int(number_at("disk")),
        int(number_at("disk", 1)),
        number_at("now") - now_s if numbers("now") else 0.0,
    )
