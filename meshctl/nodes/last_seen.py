"""The last known state of an unreachable node, and which nodes still hear it.

`query_neighbors` observes the nodes that may hear it, `last_seen_of` (pure) combines their observations with the
journal, `LastSeen.text` is one line for the operator.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from meshctl.device.observation import Observation
from meshctl.fleet import Interrupt
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet
from meshctl.nodes.collect import FleetObservation, collect, known_macs
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.slots import nodes_in_work
from meshctl.report.duration import duration
from meshctl.topology import Sighting, names_by_mac, report_of, seen_by
from meshctl.wording import counted

# batman-adv purges an originator after 200 s (PURGE_TIMEOUT, net/batman-adv/main.h).
REMEMBERED_MS = 200_000
# Neighbors come first; observing more nodes than this would delay the end of a large fleet's run.
MAX_QUERIED = 12
# How many of the nodes that hear it are named.
MAX_NAMED = 3


@dataclass(frozen=True, slots=True)
class LastSeen:
    """`heard` by direct neighbors, `routed` by nodes with a route to it, both latest first; `asked` is the number of
    nodes observed."""

    last: LastKnown | None
    heard: tuple[Sighting, ...]
    routed: tuple[Sighting, ...]
    asked: int

    def text(self, now_s: float) -> str:
        """`last seen 40 s ago (12:03:05 UTC), up 2 h, r24106; heard by b02 0.4 s ago (-61 dBm)`."""
        return "; ".join(part for part in (self._last_text(now_s), self._heard_text()) if part)

    def _last_text(self, now_s: float) -> str:
        if self.last is None:
            return "never seen before"
        moment = datetime.fromtimestamp(self.last.seen_s, UTC)
        age_s = max(0.0, now_s - self.last.seen_s)
        # the time of day alone is ambiguous after half a day
        shown = moment.strftime("%H:%M:%S UTC" if age_s < 12 * 3600 else "%Y-%m-%d %H:%M UTC")
        parts = [f"last seen {duration(age_s)} ago ({shown})"]
        uptime = self.last.facts.get("uptime_s", "")
        if uptime.isdigit():
            parts.append(f"up {duration(float(uptime))} then")
        parts += [text for key in ("version", "revision") if (text := self.last.facts.get(key))]
        return ", ".join(parts)

    def _heard_text(self) -> str:
        if self.heard:
            return "heard by " + ", ".join(_sighting(sighting) for sighting in self.heard[:MAX_NAMED])
        if self.routed:
            return "no reachable neighbor hears it; a route to it is known by " + ", ".join(
                _sighting(sighting) for sighting in self.routed[:MAX_NAMED]
            )
        if not self.asked:
            return "no other node is reachable"
        return f"heard by none of the {counted(self.asked, 'node')} that answered"

    @property
    def facts(self) -> dict[str, str]:
        """For scripts, beside an outcome."""
        facts = {
            "last_seen_s": "" if self.last is None else f"{self.last.seen_s:.0f}",
            "heard_by": " ".join(f"{sighting.by}:{sighting.age_ms}ms" for sighting in self.heard),
            "routed_by": " ".join(f"{sighting.by}:{sighting.age_ms}ms" for sighting in self.routed),
            "asked": str(self.asked),
        }
        return {key: value for key, value in facts.items() if value}


def _sighting(sighting: Sighting) -> str:
    age_s = sighting.age_ms / 1000
    signal = f" ({sighting.signal_dbm} dBm)" if sighting.signal_dbm is not None else ""
    return f"{sighting.by} {age_s:.1f} s ago{signal}" if age_s < 10 else f"{sighting.by} {duration(age_s)} ago{signal}"


def last_seen_of(
    fleet: Fleet, names: Iterable[str], observations: Mapping[str, Observation], known: Mapping[str, LastKnown]
) -> dict[str, LastSeen]:
    """Last known facts about each of `names`, from the other nodes' observations and the journal."""
    missing = tuple(names)
    others = {name: observation for name, observation in observations.items() if name not in missing}
    reports = [report_of(name, observation) for name, observation in others.items()]
    macs = known_macs(fleet, known)
    heard = seen_by(reports, macs, fresh_ms=REMEMBERED_MS)
    routed = _routed(others, names_by_mac(reports, macs))
    return {name: LastSeen(known.get(name), heard.get(name, ()), routed.get(name, ()), len(others)) for name in missing}


def _routed(observations: Mapping[str, Observation], names: Mapping[str, str]) -> dict[str, tuple[Sighting, ...]]:
    """Node -> the nodes with an originator entry of it, latest first."""
    latest: dict[str, dict[str, int]] = {}
    for by, observation in observations.items():
        for entry in observation.originators or ():
            name = names.get(entry.mac.lower())
            if name is not None and name != by and entry.last_seen_ms <= REMEMBERED_MS:
                ages = latest.setdefault(name, {})
                ages[by] = min(entry.last_seen_ms, ages.get(by, REMEMBERED_MS))
    return {
        name: tuple(sorted((Sighting(by, age) for by, age in ages.items()), key=lambda s: (s.age_ms, s.by)))
        for name, ages in latest.items()
    }


def query_neighbors(
    connections: ConnectionPool,
    fleet: Fleet,
    names: Iterable[str],
    before: FleetObservation,
    known: Mapping[str, LastKnown],
    *,
    interrupt: Interrupt,
) -> dict[str, LastSeen]:
    """The same, from new observations of former neighbors, their bases, and some other nodes that answered before."""
    missing = tuple(names)
    graph = before.graph(fleet, known)
    neighbors = [other for name in missing for other in graph.neighbors.get(name, ())]
    witnesses = [
        name
        for name in dict.fromkeys((*neighbors, *fleet.bases_of(missing), *before.observations))
        if name in fleet.nodes and name not in missing
    ]
    observed = collect(
        connections,
        [fleet.nodes[name] for name in witnesses[:MAX_QUERIED]],
        parallel=nodes_in_work(fleet.apply.parallel),
        interrupt=interrupt,
    )
    return last_seen_of(fleet, missing, observed.observations, known)
