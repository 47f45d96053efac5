"""An example: says when a robot should turn back before it loses its link. Copy it, with mesh_client.py, and change it.

    $ python3 -m udp_mesh.client.turn_back base --bits-per-s 300000 --priority 9
    go: 12.1 Mbit/s
    turn-back: worsening, 300 kbit/s for 48 s more

It prints a line when the decision changes; an autonomy calls `decide` with each `conditions` event and drives. Standard
library, Python 3.8 or later.
"""

import argparse
import math
import sys
from typing import Any, Iterator, Mapping, NamedTuple, Optional, Sequence

from udp_mesh.client.mesh_client import DEFAULT_SOCKET, MeshClient, MeshError

CONDITIONS_TOPIC = "~mesh/conditions"
NO_ANSWER_S = 2.0
TURN_LOSS, GO_LOSS = 0.1, 0.05
"""A radio repeats each frame several times, so that a link which loses packets nevertheless is close to its end."""
GO_FACTOR = 2.0
"""So many times the rate that is needed must be there before the robot continues."""
GO_MARGIN_DB = 6.0
"""So much more than the radio margin that is needed must be there before the robot continues."""
STEEP_DB = 20.0
"""With so much more than the needed margin its trend says nothing: near a radio the signal falls steeply, then less."""


class Need(NamedTuple):
    """The mission's requirements of the link."""

    bits_per_s: float
    priority: int
    """Of the topic that needs it."""
    reserve_s: float = 60.0
    """Time before the rate is no longer there at which the robot turns. A link fails faster than a trend says."""
    margin_db: Optional[float] = None
    """Radio margin of the next hop below which the robot turns, where a collector reports it. None: any."""


class Decision(NamedTuple):
    turn_back: bool
    reason: str


def decide(peer: Optional[Mapping[str, Any]], need: Need, before: bool) -> Decision:
    """`peer`: an entry of `peers` in the conditions, None if there is none; `before`: the robot is on its way back."""
    if peer is None or not peer["online"]:
        return Decision(True, "offline")
    if (peer["unanswered_for_s"] or 0.0) >= NO_ANSWER_S:
        return Decision(True, "no answer for {:.0f} s".format(peer["unanswered_for_s"]))
    radio = judge_radio(peer.get("radio"), need, before)
    if radio is not None and radio.turn_back:
        return radio
    available = peer["available_bits_per_s"]
    if available is None:
        # too little was sent: there is no reason to change anything
        return radio or Decision(before, "not measured yet")
    bits_per_s = available[need.priority]
    if bits_per_s < need.bits_per_s:
        return Decision(True, "{} of {}".format(rate(bits_per_s), rate(need.bits_per_s)))
    left_s = time_left_s(bits_per_s, need.bits_per_s, peer["trend"])
    if left_s < need.reserve_s:
        return Decision(True, "worsening, {} for {:.0f} s more".format(rate(need.bits_per_s), left_s))
    if peer["loss"] >= TURN_LOSS:
        return Decision(True, "{:.0f} % of the packets are lost".format(peer["loss"] * 100))
    is_good = bits_per_s >= GO_FACTOR * need.bits_per_s and peer["loss"] < GO_LOSS and left_s == math.inf
    if before and not is_good:
        return Decision(True, "not good enough yet: {}".format(rate(bits_per_s)))
    return Decision(False, rate(bits_per_s))


def judge_radio(radio: Optional[Mapping[str, Any]], need: Need, before: bool) -> Optional[Decision]:
    """The decision from the radio margin alone; None if no margin is required or known."""
    if need.margin_db is None or radio is None or radio["margin_db"] is None:
        return None
    margin_db, left_db = radio["margin_db"], radio["margin_db"] - need.margin_db
    shown = "{:.0f} dB of margin to {}".format(margin_db, radio["next_hop"])
    if left_db < 0.0:
        return Decision(True, shown)
    left_s = margin_left_s(left_db, radio["trend"])
    if left_s < need.reserve_s:
        return Decision(True, "{}, for {:.0f} s more".format(shown, left_s))
    if before and (left_db < GO_MARGIN_DB or left_s < math.inf):
        return Decision(True, "not good enough yet: {}".format(shown))
    return Decision(False, shown)


def margin_left_s(left_db: float, trend: Optional[Mapping[str, Any]]) -> float:
    """Until the margin is less than what is needed if the trend continues; infinite unless it falls, or far above."""
    change_db_per_s = 0.0 if trend is None else float(trend["change_db_per_s"] or 0.0)
    if trend is None or trend["direction"] != "worsening" or change_db_per_s >= 0.0 or left_db > STEEP_DB:
        return math.inf
    return left_db / -change_db_per_s


def time_left_s(bits_per_s: float, needed_bits_per_s: float, trend: Optional[Mapping[str, Any]]) -> float:
    """Until the rate falls below what is needed if the trend continues; infinite unless the capacity falls."""
    if trend is None or trend["direction"] != "worsening" or trend["measure"] != "capacity":
        return math.inf
    return math.log(bits_per_s / needed_bits_per_s) / -float(trend["change_per_s"])


def rate(bits_per_s: float) -> str:
    return "{:.1f} Mbit/s".format(bits_per_s / 1e6) if bits_per_s >= 1e6 else "{:.0f} kbit/s".format(bits_per_s / 1e3)


def decisions(mesh: MeshClient, name: str, need: Need) -> Iterator[Decision]:
    """A decision per period of the daemon's conditions. Raises MeshError when the daemon is gone."""
    mesh.subscribe(CONDITIONS_TOPIC)
    turn_back = False
    while True:
        frame = mesh.next_frame()
        if frame is None or frame[0].get("event") != "conditions":
            continue
        peers = {peer["name"]: peer for peer in frame[0]["conditions"]["peers"]}
        decision = decide(peers.get(name), need, turn_back)
        turn_back = decision.turn_back
        yield decision


def main(arguments: Optional[Sequence[str]] = None) -> int:
    parser = argparse.ArgumentParser(description="Say when a robot should turn back before it loses its link.")
    parser.add_argument("peer", help="the robot or base that must stay in reach")
    parser.add_argument("--bits-per-s", type=float, default=100e3, help="rate that it must receive (default: 100000)")
    parser.add_argument(
        "--priority", type=int, default=9, choices=range(16), metavar="N", help="priority of that rate (default: 9)"
    )
    parser.add_argument(
        "--reserve",
        type=float,
        default=60.0,
        metavar="SECONDS",
        help="turn this long before the rate is lost (default: 60)",
    )
    parser.add_argument("--margin", type=float, metavar="DB", help="turn below this radio margin, where it is known")
    parser.add_argument("--socket", default=DEFAULT_SOCKET, help="the daemon's socket (default: %(default)s)")
    given = parser.parse_args(arguments)
    last: Optional[bool] = None
    try:
        with MeshClient(given.socket) as mesh:
            need = Need(given.bits_per_s, given.priority, given.reserve, given.margin)
            for decision in decisions(mesh, given.peer, need):
                if decision.turn_back != last:
                    last = decision.turn_back
                    sys.stdout.write("{}: {}\n".format("turn-back" if last else "go", decision.reason))
                    sys.stdout.flush()
    except MeshError as error:
        sys.stderr.write("turn_back: {}\n".format(error))
        return 1
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
