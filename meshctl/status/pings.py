"""Do urgent messages get through, now: every robot's daemon sends one to every other's and waits for the answer.

`ping` asks one robot to do so, `parse_pings` reads what it tells, and `Pings` holds all of them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from meshctl.robots.host import Host

# Five seconds for each group of five peers, and the programs' own start on a small board.
PING_TIMEOUT_S = 90.0


@dataclass(frozen=True, slots=True)
class Pings:
    """`round_trips_s[a, b]` is what `a` measured to `b` and back; `failed[a, b]` is why there was no answer."""

    round_trips_s: Mapping[tuple[str, str], float] = field(default_factory=dict)
    failed: Mapping[tuple[str, str], str] = field(default_factory=dict)


def ping(host: Host, peers: Iterable[str]) -> dict[str, float | str]:
    """By peer: seconds there and back, or why there was no answer. Raises what `Host.run` raises."""
    wanted = tuple(peers)
    return parse_pings(host.run("ping", *wanted, timeout_s=PING_TIMEOUT_S), wanted)


def parse_pings(text: str, peers: Iterable[str]) -> dict[str, float | str]:
    """The lines of `scripts/ping.sh`; a peer without a line has no answer."""
    found: dict[str, float | str] = {}
    for line in text.splitlines():
        try:
            told = json.loads(line)
        except ValueError:
            continue
        if isinstance(told, dict) and isinstance(told.get("peer"), str):
            seconds = told.get("round_trip_s")
            if isinstance(seconds, int | float) and not isinstance(seconds, bool):
                found[told["peer"]] = float(seconds)
            else:
                found[told["peer"]] = str(told.get("error", "no answer"))
    return {peer: found.get(peer, "the daemon did not try") for peer in peers}


def pings_of(answers: Mapping[str, Mapping[str, float | str]]) -> Pings:
    """All robots' answers, by the robot that asked."""
    pairs = {(name, peer): answer for name, told in answers.items() for peer, answer in told.items()}
    return Pings(
        {pair: answer for pair, answer in pairs.items() if isinstance(answer, float)},
        {pair: answer for pair, answer in pairs.items() if isinstance(answer, str)},
    )
