"""The links of one node's mesh radios and its paths, in one short round trip: scripts/links.sh.

`read_links` is a round trip of its own, for the path to the base; `answering_script` answers many requests over one
connection, with all paths. `parse_links` is pure. About 120 bytes per station, so that once a second is affordable.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from meshctl.device.framing import quoted
from meshctl.device.observation import Originator, Station
from meshctl.device.parse import batctl, iw
from meshctl.device.parse.sections import OutputSection, split_sections
from meshctl.device.scripts import script

if TYPE_CHECKING:
    # the collector on a robot has no SSH library
    from meshctl.device.connection import Connection

MAX_INACTIVE_MS = 3000
"""A station that was silent for longer is no link: a mesh radio sends several frames a second."""
LAST_SECTION = "done"
"""With its end an answer is complete."""
_MAC = re.compile(r"(?:[0-9a-f]{2}:){5}[0-9a-f]{2}")


@dataclass(frozen=True, slots=True)
class LinkTable:
    """One node's links at `taken_s`. By MAC of the station are `signals_dbm`, `noise_dbm`, and `expected_mbit_s` as far
    as the driver tells. `next_hop` is the MAC of the best next hop to the base, empty if the node has no path. `paths`
    are the rows of originators that were asked for; None if the node has no such table."""

    taken_s: float
    signals_dbm: Mapping[str, int]
    noise_dbm: Mapping[str, int | None]
    next_hop: str = ""
    expected_mbit_s: Mapping[str, float] = field(default_factory=dict)
    paths: tuple[Originator, ...] | None = None


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
    rows = f"^[ *]*({'|'.join(macs) or 'none'}) "
    return f"N={quoted(nonce)}\nROWS={quoted(rows)}\n{_body()}\n"


def answering_script() -> str:
    """links.sh without a nonce: it answers each line of its standard input, a nonce, until that ends.

    It reads nothing else, so that a key whose forced command it is can do nothing else.
    """
    return f"N= ROWS=\n{_body()}\n"


def _body() -> str:
    # it crosses the mesh every second: without its comments it is half as long
    lines = [line.strip() for line in script("links.sh").splitlines()]
    return "\n".join(line for line in lines if line and not line.startswith("#"))


def is_complete(output: bytes | bytearray, nonce: str) -> bool:
    """Whether these are all sections of an answer of `answering_script`."""
    return output.endswith(f"{nonce} begin {LAST_SECTION}\n\n{nonce} end 0\n".encode())


def parse_links(sections: Mapping[str, OutputSection], base_macs: Iterable[str], *, taken_s: float) -> LinkTable:
    """The sections of links.sh. Any input gives a table."""
    signals: dict[str, int] = {}
    noise: dict[str, int | None] = {}
    expected: dict[str, float] = {}
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
                if station.expected_mbit_s is not None:
                    expected[station.mac] = station.expected_mbit_s
    rows = _rows(sections)
    next_hop = _next_hop(rows or (), {mac.lower() for mac in base_macs})
    return LinkTable(taken_s, signals, noise, next_hop, expected, rows)


def _signal(station: Station) -> int | None:
    """The signal of a station that was heard lately: of its last frame, which follows a moving robot. None for a mesh
    peer whose link is not established, such as one that failed to authenticate: no frame passes."""
    if not station.can_forward:
        return None
    if station.inactive_ms is not None and station.inactive_ms > MAX_INACTIVE_MS:
        return None
    return station.signal_dbm if station.signal_dbm is not None else station.signal_avg_dbm


def _rows(sections: Mapping[str, OutputSection]) -> tuple[Originator, ...] | None:
    tables = [section for name, section in sections.items() if name.startswith("batctl.path ")]
    if not tables:
        return None
    return tuple(row for table in tables for row in batctl.parse_originators_text(table.text) or ())


def _next_hop(rows: Iterable[Originator], base_macs: set[str]) -> str:
    to_base = (row for row in rows if row.mac in base_macs)
    best = max(to_base, key=lambda row: (row.best, row.tq or 0, row.throughput_kbit_s or 0), default=None)
    return "" if best is None else best.next_hop
