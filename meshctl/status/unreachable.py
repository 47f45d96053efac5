"""Why somebody gave no answer, and what that means: an error -> `Silence` -> an alarm, or none for what may be off."""

from __future__ import annotations

import re
from collections.abc import Sequence

from meshctl.device.errors import AuthenticationRefused, HostKeyChanged, HostKeyUnknown
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet.journal import LastKnown
from meshctl.model import Node, NodeState, Role
from meshctl.status.node_alarms import duration, join_limited
from meshctl.status.values import Alarm, Level, NoAnswer
from meshctl.topology import Sighting

NOT_ASKED = NoAnswer("was not asked")


def no_answer_of(error: NodeError) -> NoAnswer:
    """The reason in a sentence, without the device's name and address, which stand beside it."""
    match error:
        case Unreachable():
            code = "unreachable"
        case HostKeyChanged():
            code = "host-key"
        case HostKeyUnknown():
            code = "untrusted"
        case AuthenticationRefused():
            code = "login"
        case _:
            code = "failed"
    return NoAnswer(re.sub(r"^\S+ \(\S+\): ", "", str(error)), code, error.hint)


def no_answer_alarm(
    why: NoAnswer,
    last: LastKnown | None,
    heard_by: Sequence[Sighting],
    now: float,
    *,
    is_required: bool,
    trust: str,
    first_contact_hint: str,
) -> Alarm | None:
    """What is wrong with a device that gave no answer; None for one that may be off and is heard by nobody.

    `is_missed` for one that must answer; `trust` is the command that pins its host key, `take_in` what to do with one
    that never answered.
    """
    seen = sighting_text(heard_by)
    if why.code != "unreachable":
        # it is there and keeps us out, wherever it is meant to be
        hints = {
            "host-key": f"another device, a flash by hand, or an attack: compare at the device, then {trust} --replace",
            "untrusted": f"compare the fingerprint at the device, then {trust}",
        }
        return Alarm(Level.ERROR, why.code, why.reason, hints.get(why.code, why.hint))
    if not is_required:
        # switched on, in reach of others, and yet without an answer: worth a look before it is dropped
        hint = "wait a minute for it to start; then look at its address and cable"
        return Alarm(Level.WARNING, "mute", f"{why.reason}, but {seen}", hint) if seen else None
    told = f"last answered {duration(now - last.seen_s)} ago" if last else "has never answered"
    if seen:
        hint = "it is on and in reach: wait a minute, then switch it off and on"
        return Alarm(Level.ERROR, "unreachable", f"{why.reason}; {told}; {seen}", hint)
    hint = first_contact_hint if last is None else last_place_hint(last)
    return Alarm(Level.ERROR, "unreachable", f"{why.reason}; {told}; nobody hears it", hint)


def lost_relay_alarm(node: Node, why: NoAnswer, last: LastKnown | None, now: float) -> Alarm | None:
    """What is wrong with a beacon that is in a rack by the inventory and does not answer: None for one that was not
    needed when it last did. One that others reached the base through had been dropped, and is gone."""
    relayed = () if last is None else tuple(last.facts.get("relays", "").split())
    is_racked = node.state is NodeState.CARRIED and node.role is Role.BEACON
    if last is None or not relayed or not is_racked or why.code != "unreachable":
        return None
    text = f"{why.reason}; {join_limited(relayed)} reached the base through it {duration(now - last.seen_s)} ago"
    where = f"meshctl deployed {node.name}, and {last_place_hint(last)}"
    hint = f"if it was dropped: {where}; if it is back in its rack: switch it on there once"
    return Alarm(Level.WARNING, "dropped", text, hint)


def sighting_text(heard_by: Sequence[Sighting]) -> str:
    """`b02 hears it (-63 dBm, 0.4 s ago), and 2 others`; empty where nobody does."""
    if not heard_by:
        return ""
    first = heard_by[0]
    signal = "" if first.signal_dbm is None else f"{first.signal_dbm} dBm, "
    others = f", and {len(heard_by) - 1} other{'s' if len(heard_by) > 2 else ''}" if len(heard_by) > 1 else ""
    return f"{first.by} hears it ({signal}{first.age_ms / 1000:.1f} s ago){others}"


def last_place_hint(last: LastKnown) -> str:
    """Where to look for a device that is gone."""
    via, hops = last.facts.get("via", ""), last.facts.get("hops", "")
    where = f"it was {hops} hop{'' if hops == '1' else 's'} out, behind {via}: " if via else ""
    return f"{where}look for power and antenna there" if where else "look for power, cable and antenna"
