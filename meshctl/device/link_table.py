"""The links of one node's mesh radios and its next hop to the base, in one short round trip: scripts/links.sh.

`read_links` is the round trip, `parse_links` is pure. About 120 bytes per station, so that once a second is affordable.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from meshctl.device.connection import Connection
from meshctl.device.framing import quoted
from meshctl.device.observation import Station
from meshctl.device.parse import batctl, iw
from meshctl.device.parse.sections import OutputSection, split_sections
from meshctl.device.scripts import script

MAX_INACTIVE_MS = 3000
"""A station that was silent for longer is no link: a mesh radio sends several frames a second."""
_MAC = re.compile(r"(?:[0-9a-f]{2}:){5}[0-9a-f]{2}")


@dataclass(frozen=True, slots=True)
class LinkTable:
    """One node's links at `taken_s`. `signals_dbm` and `noise_dbm` are by MAC of the station; `next_hop` is the MAC of
    the best next hop to the base, empty if the node has no path."""

    taken_s: float
    signals_dbm: Mapping[str, int]
    noise_dbm: Mapping[str, int | None]
    next_hop: str = ""


def read_links(
    connection: Connection, base_macs: Iterable[str], *, timeout_s: float, clock: Callable[[], float] = time.time
) -> LinkTable:
    """Query one node. Raises Timeout and ConnectionLost; what the node does not report is missing in the table."""
    nonce = f"meshctl-{secrets.token_hex(16)}"
    done = connection.run(links_script(nonce, base_macs), timeout_s=timeout_s)
    return parse_links(split_sections(done.stdout_bytes, nonce), base_macs, taken_s=clock())


def links_script(nonce: str, base_macs: Iterable[str]) -> str:
    """links.sh with its inputs set; without a base, no originator matches."""
    macs = [mac.lower() for mac in base_macs if _MAC.fullmatch(mac.lower())]
    # it crosses the mesh every second: without its comments it is half as long
    lines = [line.strip() for line in script("links.sh").splitlines()]
    body = "\n".join(line for line in lines if line and not line.startswith("#"))
    return f"N={quoted(nonce)}\nBASE={quoted('|'.join(macs) or 'none')}\n{body}\n"


def parse_links(sections: Mapping[str, OutputSection], base_macs: Iterable[str], *, taken_s: float) -> LinkTable:
    """The sections of links.sh. Any input gives a table."""
    signals: dict[str, int] = {}
    noise: dict[str, int | None] = {}
    for name, section in sections.items():
        kind, _, ifname = name.partition(" ")
        if kind != "iw.stations":
            continue
        survey = sections.get(f"iw.survey {ifname}")
        found = None if survey is None else iw.parse_survey(survey.text)
        for station in iw.parse_stations(section.text) or ():
            signal = _signal(station)
            if signal is not None:
                signals[station.mac] = signal
                noise[station.mac] = None if found is None else found.noise_dbm
    return LinkTable(taken_s, signals, noise, _next_hop(sections, {mac.lower() for mac in base_macs}))


def _signal(station: Station) -> int | None:
    """The signal of a station that was heard lately: of its last frame, which follows a moving robot."""
    if station.inactive_ms is not None and station.inactive_ms > MAX_INACTIVE_MS:
        return None
    return station.signal_dbm if station.signal_dbm is not None else station.signal_avg_dbm


def _next_hop(sections: Mapping[str, OutputSection], base_macs: set[str]) -> str:
    rows = [
        row
        for name, section in sections.items()
        if name.startswith("batctl.path ")
        for row in batctl.parse_originators_text(section.text) or ()
        if row.mac in base_macs
    ]
    best = max(rows, key=lambda row: (row.best, row.tq or 0, row.throughput_kbit_s or 0), default=None)
    return "" if best is None else best.next_hop
