"""Which of a node's radios start anew: told beforehand from its wireless settings, or afterwards by its radios. Pure.

A radio that starts anew counts its frames from 0, which those that know it have to be told (`apply/forget.py`). One
that did not must not be taken for it, or it does not hear them for minutes itself. So what changes elsewhere, bat0 made
anew included, is no reason, and of two radios only the one whose settings differ is meant.
"""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.device.observation import Observation
from meshctl.uci import Package, Section

# iw counts whole seconds, and a question takes its time.
SLACK_S = 2.0


@dataclass(frozen=True, slots=True)
class Radios:
    """The radios with these interfaces, or all that the node has."""

    ifnames: frozenset[str] = frozenset()
    every: bool = False

    def __contains__(self, ifname: object) -> bool:
        return self.every or ifname in self.ifnames

    def __bool__(self) -> bool:
        return self.every or bool(self.ifnames)


NO_RADIOS = Radios()
EVERY_RADIO = Radios(every=True)


def restarted(before: Package | None, after: Package | None) -> Radios:
    """Those that netifd sets up anew when /etc/config/wireless becomes `after`: whole radios, each whose own section or
    one of whose interfaces differs (netifd, wireless.c). A package that nobody can read may have held anything."""
    if before is None or after is None:
        return EVERY_RADIO
    new = _by_device(after)
    differing = [parts for name, parts in _by_device(before).items() if parts != new.get(name)]
    faces = [section for parts in differing for section in parts if section.type == "wifi-iface"]
    ifnames = frozenset(section.get("ifname") for section in faces)
    return EVERY_RADIO if "" in ifnames else Radios(ifnames)


def _by_device(wireless: Package) -> dict[str, tuple[Section, ...]]:
    """Each radio's own section and those of its interfaces."""
    return {
        device.name: (device, *(face for face in wireless.of_type("wifi-iface") if face.get("device") == device.name))
        for device in wireless.of_type("wifi-device")
        if device.name is not None
    }


def started_within(seen: Observation, seconds: float) -> Radios:
    """The radios that must have started within these last seconds: they know somebody, and nobody for longer; or the
    whole node has. One that knows nobody, or does not tell for how long, is not taken for one that did.
    """
    # two clocks: one that booted just before has started its radios anew just as well
    if seen.uptime_s is not None and seen.uptime_s < seconds + SLACK_S:
        return EVERY_RADIO
    known: dict[str, list[int | None]] = {}
    for station in seen.stations or ():
        known.setdefault(station.ifname, []).append(station.connected_s)
    return Radios(
        frozenset(
            ifname for ifname, ages in known.items() if all(age is not None and age < seconds - SLACK_S for age in ages)
        )
    )
