"""How the daemons fare: `scripts/watch.sh` -> sections -> `Health` -> a table or JSON.

Also what differs between a robot and the inventory (`difference`), without changing anything.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from meshctl.robots.bundle import Bundle
from meshctl.robots.host import Host
from meshctl.robots.target import Facts, changed_files

WATCH_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True)
class Health:
    """One robot's daemon. `status` and `topics` are what `udp-mesh status --json` and `topics --json` print, empty
    where no daemon answers; `trouble` is why the computer itself could not be asked."""

    robot: str
    active: str = ""
    enabled: str = ""
    release: str = ""
    previous: str = ""
    is_proven: bool = True
    status: Mapping[str, Any] = field(default_factory=dict)
    topics: tuple[Mapping[str, Any], ...] = ()
    trouble: str = ""

    @property
    def peers(self) -> tuple[Mapping[str, Any], ...]:
        return tuple(self.status.get("conditions", {}).get("peers", ()))

    @property
    def online(self) -> tuple[str, ...]:
        return tuple(str(peer["name"]) for peer in self.peers if peer.get("online"))

    @property
    def is_well(self) -> bool:
        return not self.trouble and self.active == "active" and self.is_proven and bool(self.status)


def health(host: Host, robot: str) -> Health:
    """Ask one robot."""
    return parse_health(robot, host.run("watch", timeout_s=WATCH_TIMEOUT_S))


def parse_health(robot: str, text: str) -> Health:
    """The sections of `scripts/watch.sh`; one that is no JSON counts as no answer."""
    sections: dict[str, list[str]] = {}
    name = ""
    for line in text.splitlines():
        if line.startswith("== "):
            name = line.removeprefix("== ")
        sections.setdefault(name, []).append("" if line.startswith("== ") else line)
    service = dict(line.partition("=")[::2] for line in sections.get("service", ()))
    return Health(
        robot,
        active=service.get("active", ""),
        enabled=service.get("enabled", ""),
        release=service.get("current", ""),
        previous=service.get("previous", ""),
        is_proven=service.get("proven", "yes") == "yes",
        status=_object(sections.get("status", ())),
        topics=tuple(_object(sections.get("topics", ())).get("topics", ())),
    )


def _object(lines: Iterable[str]) -> dict[str, Any]:
    try:
        value = json.loads("\n".join(lines))
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def health_object(one: Health) -> dict[str, Any]:
    """For scripts."""
    return {
        "robot": one.robot,
        "well": one.is_well,
        "trouble": one.trouble,
        "active": one.active,
        "enabled": one.enabled,
        "release": one.release,
        "previous": one.previous,
        "proven": one.is_proven,
        "online": list(one.online),
        "status": dict(one.status),
        "topics": [dict(topic) for topic in one.topics],
    }


def table(rows: Iterable[Health]) -> str:
    """One line a robot: what runs, for how long, whom it sees, what waits."""
    lines = [("robot", "service", "release", "version", "up", "peers", "queued", "keys", "")]
    for one in rows:
        if one.trouble:
            lines.append((one.robot, "?", "", "", "", "", "", "", one.trouble))
            continue
        status = one.status
        conditions = status.get("conditions", {})
        lines.append(
            (
                one.robot,
                one.active or "absent",
                one.release or "-",
                str(status.get("version", "-")),
                _duration(status.get("uptime_s")),
                f"{len(one.online)}/{len(one.peers)}" if status else "-",
                f"{conditions.get('queued_bytes', 0)} B" if status else "-",
                "UNKEYED" if status.get("unkeyed") else " ".join(str(key)[:8] for key in status.get("keys", ())) or "-",
                _remark(one),
            )
        )
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def _remark(one: Health) -> str:
    if not one.is_proven:
        return "a switch was cut short: deploy again"
    if one.active == "active" and not one.status:
        return "the daemon does not answer"
    away = [str(peer["name"]) for peer in one.peers if not peer.get("online")]
    return f"away: {', '.join(away)}" if away else ""


def _duration(seconds: object) -> str:
    if not isinstance(seconds, int | float):
        return "-"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def difference(facts: Facts, release: Bundle) -> tuple[str, ...]:
    """One line for each way in which a robot is not as the inventory says; none when a deploy would do nothing.

    Files are named, not shown: what is on the robot is known by its hash.
    """
    if not facts.current:
        return (f"nothing is installed; deploy would install {release.id}",)
    lines = [f"changed on the robot: {path}" for path in facts.damaged]
    lines += [f"differs from the inventory: {path}" for path in changed_files(facts, release.hashes)]
    if not facts.is_proven:
        lines.append("a switch was cut short")
    if facts.active != "active":
        lines.append(f"the service is {facts.active or 'absent'}")
    if facts.enabled != "enabled":
        lines.append(f"the service is {facts.enabled or 'absent'}: it will not start at boot")
    return tuple(lines)
