"""Which of a node's radios restart: predicted from its wireless settings, or observed afterwards. Pure.

`radio_changes` predicts what netifd does with each radio, by release; the plan shows it. `restarting_radios` are those
that may restart at all, so that neighbors look for stale station entries (`apply/stale_stations.py`).
`observed_restarts` and `started_within` are those that did.
"""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.device.observation import Observation
from meshctl.model import Release
from meshctl.uci import Package, Section

# iw counts whole seconds, and a query takes time.
SLACK_S = 2.0


@dataclass(frozen=True, slots=True)
class Radios:
    """The radios with these interfaces, or all radios of the node."""

    ifnames: frozenset[str] = frozenset()
    is_all: bool = False

    def __contains__(self, ifname: object) -> bool:
        return self.is_all or ifname in self.ifnames

    def __bool__(self) -> bool:
        return self.is_all or bool(self.ifnames)


NO_RADIOS = Radios()
EVERY_RADIO = Radios(is_all=True)


def restarting_radios(before: Package | None, after: Package | None) -> Radios:
    """The radios that may restart when /etc/config/wireless becomes `after`: those whose section or an interface
    differs, be it in the order of options; all radios if a package is unreadable."""
    if before is None or after is None:
        return EVERY_RADIO
    new = _by_device(after)
    differing = [
        parts
        for name, parts in _by_device(before).items()
        if parts != new.get(name) or _reordered(parts, new.get(name, ()))
    ]
    faces = [section for parts in differing for section in parts if section.type == "wifi-iface"]
    ifnames = frozenset(section.get("ifname") for section in faces)
    return EVERY_RADIO if "" in ifnames else Radios(ifnames)


# Options of a wifi-device that 23.05 and later set through `iw phy`, without touching the interfaces (wifi-scripts,
# mac80211.sh and wdev.uc; txpower was run on 24.10 and 25.12). Up to 22.03 netifd takes the whole radio down and up for
# every difference (wireless.c: IFC_RELOAD).
IN_PLACE = frozenset({"txpower", "distance", "rts", "frag", "country", "antenna_gain"})
# Of these, the options that may break a weak link: less range, or a shorter wait for acknowledgments.
RANGE = frozenset({"txpower", "distance", "country", "antenna_gain"})


@dataclass(frozen=True, slots=True)
class RadioChange:
    """The change of one radio: `options` differ, in its section or its interfaces'. `restarts`: its interfaces go down
    and up; `may_lose_range`: they stay up, with less range; `rejoins`: they stay on the air, but leave their network
    (bat0) and return. `has_links`: it has links to other nodes, before or after; other radios serve access points, or
    nothing. ORDER among `options`: options that are equal stand in another order."""

    radio: str
    options: tuple[str, ...]
    restarts: bool
    may_lose_range: bool = False
    rejoins: bool = False
    has_links: bool = True


ORDER = "order of options"


def radio_changes(before: Package, after: Package, release: Release) -> tuple[RadioChange, ...]:
    """The change of each radio that differs in /etc/config/wireless, on that release."""
    old, new = _by_device(before), _by_device(after)
    changes = []
    for name, parts in {**old, **new}.items():
        old_parts, new_parts = old.get(name, ()), new.get(name, ())
        reordered = _reordered(old_parts, new_parts)
        # netifd compares settings byte by byte, in the order of the file: up to 22.03 a difference restarts the radio,
        # on 23.05 and 24.10 one in an interface's section reconnects that (wireless.c); 25.12 compares by name
        moved_device = release < Release.V23_05 and bool(reordered)
        moved_faces = release < Release.V25_12 and "wifi-iface" in reordered
        if old_parts == new_parts and not moved_device and not moved_faces:
            continue
        device = _differing(old_parts[:1], new_parts[:1])
        faces = _differing(old_parts[1:], new_parts[1:])
        in_place = set(IN_PLACE)
        # wpa_supplicant's configuration contains the country
        if any(face.get("encryption", "none") != "none" or face.get("mode") == "mesh" for face in parts[1:]):
            in_place.discard("country")
        restarts = release < Release.V23_05 or bool(faces) or not device <= in_place
        loses = bool(device & RANGE) and not _is_stronger(device, old_parts[0], new_parts[0])
        options = (*sorted(device | faces), *((ORDER,) if moved_device or moved_faces else ()))
        # nothing is known of an interface without a mode
        has_links = any(face.get("mode") != "ap" for face in (*old_parts[1:], *new_parts[1:]))
        changes.append(
            RadioChange(name, options, restarts, not restarts and loses, not restarts and moved_faces, has_links)
        )
    return tuple(changes)


def _reordered(old: tuple[Section, ...], new: tuple[Section, ...]) -> set[str]:
    """The types of sections whose common options stand in another order."""
    before = {section.name: section for section in old}
    found = set()
    for section in new:
        options = {} if (match := before.get(section.name)) is None else match.options
        common = section.options.keys() & options.keys()
        if [name for name in options if name in common] != [name for name in section.options if name in common]:
            found.add(section.type)
    return found


def _differing(old: tuple[Section, ...], new: tuple[Section, ...]) -> set[str]:
    """The options that differ, and the names of sections that only one side has."""
    before, after = ({section.name: section for section in side} for side in (old, new))
    found = {str(name) for name in before.keys() ^ after.keys()}
    for name in before.keys() & after.keys():
        first, second = dict(before[name].options), dict(after[name].options)
        found |= {option for option in first.keys() | second.keys() if first.get(option) != second.get(option)}
    return found


def _is_stronger(options: set[str], old: Section, new: Section) -> bool:
    """Whether the only change is a higher transmit power."""
    powers = old.get("txpower"), new.get("txpower")
    return options & RANGE == {"txpower"} and all(p.isdigit() for p in powers) and int(powers[0]) < int(powers[1])


def _by_device(wireless: Package) -> dict[str, tuple[Section, ...]]:
    """Each radio's own section and those of its interfaces."""
    return {
        device.name: (device, *(face for face in wireless.of_type("wifi-iface") if face.get("device") == device.name))
        for device in wireless.of_type("wifi-device")
        if device.name is not None
    }


def observed_restarts(before: Observation, now: Observation, seconds: float) -> Radios:
    """The radios that restarted between two observations, with the change `seconds` old at the second one: the node
    booted, the interface has another index, or all of its station entries are younger."""
    if before.boot_id != now.boot_id:
        return EVERY_RADIO
    old, new = before.ifindexes or {}, now.ifindexes or {}
    created = frozenset(name for name in old.keys() & new.keys() if old[name] != new[name])
    recent = started_within(now, seconds)
    return EVERY_RADIO if recent.is_all else Radios(created | recent.ifnames)


def started_within(observation: Observation, seconds: float) -> Radios:
    """The radios that must have started within the last `seconds`: all of their station entries are younger, or the
    node booted since. A radio without station entries, or with entries of unknown age, does not count.
    """
    # with slack for two clocks: a node that booted just before has restarted its radios as well
    if observation.uptime_s is not None and observation.uptime_s < seconds + SLACK_S:
        return EVERY_RADIO
    known: dict[str, list[int | None]] = {}
    for station in observation.stations or ():
        known.setdefault(station.ifname, []).append(station.connected_s)
    return Radios(
        frozenset(
            ifname for ifname, ages in known.items() if all(age is not None and age < seconds - SLACK_S for age in ages)
        )
    )
