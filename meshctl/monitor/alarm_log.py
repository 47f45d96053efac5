"""The alarm log: status document -> alarms by device and code -> what began, continues, and ended. Pure.

An alarm is one device and one code; a device with several of one code (two radios that are down) has one, with both
texts. It ends when its device answers without it, or has left the inventory: of a device that does not answer it is not
known, so it stays open. One that returns within `REOPEN_S` continues with its acknowledgment: a flapping link is one.
One that rises to a level that it did not have yet is reported again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

# The device of alarms that concern the whole fleet.
FLEET = ""
# A robot's computer may have the name of its radio; the word is that of a selection (`robot:spot1`).
ROBOT = "robot:"
# Two minutes: a link at the edge of reach comes and goes within a few samples.
REOPEN_S = 120.0
LEVELS = ("note", "warning", "error")
AlarmKey = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Acknowledgment:
    by: str
    at_s: float


@dataclass(frozen=True, slots=True)
class Silence:
    """Until `until_s`, for good if None."""

    until_s: float | None
    reason: str
    by: str


@dataclass(frozen=True, slots=True)
class LoggedAlarm:
    """One alarm from `first_s` to `last_s`, when it was last reported; `ended_s` is None while it is open."""

    device: str
    code: str
    level: str
    text: str
    hint: str
    first_s: float
    last_s: float
    ended_s: float | None = None
    acknowledged: Acknowledgment | None = None
    silenced: Silence | None = None
    peak: str = ""
    """The highest level it has had, as far as this process knows; empty if it was read from a file."""
    has_risen: bool = False
    """It rose above its peak: an acknowledgment of the lower level does not cover it."""

    @property
    def key(self) -> AlarmKey:
        return self.device, self.code

    def as_json(self) -> dict[str, Any]:
        """The alarm as docs/monitor.md has it."""
        acknowledged, silenced = self.acknowledged, self.silenced
        return {
            "device": self.device,
            "code": self.code,
            "level": self.level,
            "text": self.text,
            "hint": self.hint,
            "first_s": self.first_s,
            "last_s": self.last_s,
            "ended_s": self.ended_s,
            "acknowledged": None if acknowledged is None else {"by": acknowledged.by, "at_s": acknowledged.at_s},
            "silenced": None
            if silenced is None
            else {"until_s": silenced.until_s, "reason": silenced.reason, "by": silenced.by},
        }


@dataclass(frozen=True, slots=True)
class ReportedAlarms:
    """The alarms of one status document, and the devices of which nothing is known now."""

    alarms: Mapping[AlarmKey, tuple[str, str, str]]
    """(device, code) -> level, text, hint."""
    unknown: frozenset[str]


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """`open` are all that are open now; `began` those of them that were not before, or rose to a level that they
    did not have yet; `ended` those that ended."""

    open: Mapping[AlarmKey, LoggedAlarm]
    began: tuple[LoggedAlarm, ...]
    ended: tuple[LoggedAlarm, ...]


def reported_alarms(status: Mapping[str, Any]) -> ReportedAlarms:
    """The alarms of a status document, also of one from another version: what is not an alarm is left out."""
    found: dict[AlarmKey, tuple[str, str, str]] = {}
    unknown = set()
    for kind, prefix in (("nodes", ""), ("robots", ROBOT)):
        for entry in _maps(status.get(kind)):
            if not isinstance(entry.get("name"), str):
                continue
            device = f"{prefix}{entry['name']}"
            if entry.get("answers") is False:
                unknown.add(device)
            _merge(found, device, entry.get("alarms"))
    _merge(found, FLEET, status.get("alarms"))
    return ReportedAlarms(found, frozenset(unknown))


def devices_of(status: Mapping[str, Any]) -> frozenset[str]:
    """The devices that an alarm of this status document could name, without the fleet."""
    return frozenset(
        f"{prefix}{entry['name']}"
        for kind, prefix in (("nodes", ""), ("robots", ROBOT))
        for entry in _maps(status.get(kind))
        if isinstance(entry.get("name"), str)
    )


def _merge(found: dict[AlarmKey, tuple[str, str, str]], device: str, alarms: object) -> None:
    for alarm in _maps(alarms):
        level, code, text = alarm.get("level"), alarm.get("code"), alarm.get("text")
        if level not in LEVELS or not isinstance(code, str) or not isinstance(text, str):
            continue
        hint = str(alarm.get("hint") or "")
        if (known := found.get((device, code))) is not None:
            level = max(level, known[0], key=LEVELS.index)
            text = known[1] if text in known[1].split("; ") else f"{known[1]}; {text}"
            hint = known[2] or hint
        found[device, code] = (level, text, hint)


def _maps(value: object) -> Iterable[Mapping[str, Any]]:
    return (item for item in value if isinstance(item, Mapping)) if isinstance(value, list | tuple) else ()


def advance(
    open_alarms: Mapping[AlarmKey, LoggedAlarm],
    recently_ended: Mapping[AlarmKey, LoggedAlarm],
    reported: ReportedAlarms,
    now_s: float,
) -> AlarmChange:
    """The log after a status at `now_s`. `recently_ended` are candidates to go on."""
    after: dict[AlarmKey, LoggedAlarm] = {}
    began = []
    for (device, code), (level, text, hint) in reported.alarms.items():
        known = open_alarms.get((device, code))
        if known is None:
            ended = recently_ended.get((device, code))
            if ended is not None and ended.ended_s is not None and now_s - ended.ended_s <= REOPEN_S:
                known = replace(ended, ended_s=None)
        if known is None:
            known = LoggedAlarm(device, code, level, text, hint, first_s=now_s, last_s=now_s, peak=level)
            began.append(known)
        peak = known.peak or known.level
        has_risen = LEVELS.index(level) > LEVELS.index(peak)
        if has_risen:
            began.append(known)
            peak = level
        after[device, code] = replace(
            known, level=level, text=text, hint=hint, last_s=now_s, peak=peak, has_risen=has_risen
        )
    ended_now = []
    for key, alarm in open_alarms.items():
        if key in after:
            continue
        if alarm.device in reported.unknown:
            after[key] = alarm
        else:
            ended_now.append(replace(alarm, ended_s=now_s))
    return AlarmChange(after, tuple(after[new.key] for new in began), tuple(ended_now))
