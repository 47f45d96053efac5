"""Urgent test messages between all robots' daemons: `ping` runs them on one robot, `Pings` holds all round trips."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from meshctl.robots.host import Host

# Five seconds per group of five peers, plus the start of the programs on a small board.
PING_TIMEOUT_S = 90.0


@dataclass(frozen=True, slots=True)
class Pings:
    """`round_trips_s[a, b]` is measured by `a` to `b` and back; `failed[a, b]` is why there was no answer."""

    round_trips_s: Mapping[tuple[str, str], float] = field(default_factory=dict)
    failed: Mapping[tuple[str, str], str] = field(default_factory=dict)


def ping(host: Host, peers: Iterable[str]) -> dict[str, float | str]:
    """By peer: round-trip seconds, or why there was no answer. Raises what `Host.run` raises."""
    wanted = tuple(peers)
    return parse_pings(host.run("ping", *wanted, timeout_s=PING_TIMEOUT_S), wanted)


def replies(text: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Peer and reply of each line that is one: the scripts for robots print one JSON object per peer."""
    for line in text.splitlines():
        try:
            reply = json.loads(line)
        except ValueError:
            continue
        if isinstance(reply, dict) and isinstance(reply.get("peer"), str):
            yield reply["peer"], reply


def parse_pings(text: str, peers: Iterable[str]) -> dict[str, float | str]:
    """The lines of `scripts/ping.sh`; a peer without a line has no answer."""
    found: dict[str, float | str] = {}
    for peer, reply in replies(text):
        seconds = reply.get("round_trip_s")
        if isinstance(seconds, int | float) and not isinstance(seconds, bool):
            found[peer] = float(seconds)
        else:
            found[peer] = str(reply.get("error", "no answer"))
    return {peer: found.get(peer, "not sent") for peer in peers}


def pings_of(answers: Mapping[str, Mapping[str, float | str]]) -> Pings:
    """Merge the results of all robots."""
    pairs = {(name, peer): answer for name, replies in answers.items() for peer, answer in replies.items()}
    return Pings(
        {pair: answer for pair, answer in pairs.items() if isinstance(answer, float)},
        {pair: answer for pair, answer in pairs.items() if isinstance(answer, str)},
    )
