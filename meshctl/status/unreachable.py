"""Devices that did not answer: an error -> `NoAnswer` -> an alarm, or none for a device that may be off."""

from __future__ import annotations

import re
from collections.abc import Sequence

from meshctl.device.errors import AuthenticationRefused, HostKeyChanged, HostKeyUnknown
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet.journal import LastKnown
from meshctl.model import Node, NodeState, Role
from meshctl.report.duration import duration
from meshctl.status.node_alarms import join_limited
from meshctl.status.values import Alarm, Level, NoAnswer
from meshctl.topology import Sighting
from meshctl.wording import counted

NOT_ASKED = NoAnswer("not queried")


def no_answer_of(error: NodeError) -> NoAnswer:
    """The reason without the device's name and address, which are shown beside it."""
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
    reason = re.sub(r"^\S+ \(\S+\): ", "", str(error))
    if error.gateway_of:
        # the errors of a worker name its site
        if not reason.startswith(f"site {error.gateway_of}"):
            reason = f"gateway of {error.gateway_of}: {reason}"
        return NoAnswer(reason, code, error.hint, of_gateway=True)
    return NoAnswer(reason, code, error.hint)


def no_answer_alarm(
    why: NoAnswer,
    last: LastKnown | None,
    heard_by: Sequence[Sighting],
    now: float,
    *,
    is_required: bool,
    trust: str,
    first_contact_hint: str,
    refused_by: Sequence[Sighting] = (),
) -> Alarm | None:
    """The alarm of a device that did not answer; None for one that may be off and is heard by no node.

    `is_required`: it must answer. `trust` is the command that pins its key, `first_contact_hint` the hint for a device
    that never answered, `refused_by` the nodes whose radios hear it but have no 802.11s link to it.
    """
    sighting = sighting_text(heard_by)
    if why.of_gateway:
        return Alarm(Level.ERROR, why.code, why.reason, why.hint) if is_required else None
    if why.code != "unreachable":
        # it is on but refuses the connection, whether required or not
        hints = {
            "host-key": f"another device, a reflash, or an attack: compare at the device, then {trust} --replace",
            "untrusted": f"compare the fingerprint at the device, then {trust}",
        }
        return Alarm(Level.ERROR, why.code, why.reason, hints.get(why.code, why.hint))
    if not is_required:
        # on and in range of others, but without an answer: check it before it is dropped
        hint = why.wait_for or "wait a minute for it to boot, then check its address and cable"
        return Alarm(Level.WARNING, "mute", f"{why.reason}, but {sighting}", hint) if sighting else None
    last_answer = f"last answered {duration(now - last.seen_s)} ago" if last else "never answered"
    if why.wait_for:
        text = f"{why.reason}; {last_answer}; {sighting or 'no node hears it'}"
        return Alarm(Level.ERROR, "unreachable", text, why.wait_for)
    if sighting:
        hint = "it is on and in range: wait a minute, then run meshctl provision; if that fails, keep it off for 2 min"
        return Alarm(Level.ERROR, "unreachable", f"{why.reason}; {last_answer}; {sighting}", hint)
    if refused_by:
        text = f"{why.reason}; {last_answer}; {sighting_text(refused_by)}, but their 802.11s link does not come up"
        hint = "if it stays so, it has another key: reach it by cable, then meshctl provision with --leave-behind all"
        return Alarm(Level.ERROR, "unreachable", text, hint)
    hint = first_contact_hint if last is None else last_place_hint(last)
    return Alarm(Level.ERROR, "unreachable", f"{why.reason}; {last_answer}; no node hears it", hint)


def lost_relay_alarm(node: Node, why: NoAnswer, last: LastKnown | None, now: float) -> Alarm | None:
    """The alarm of a carried beacon that does not answer but relayed for others when it last did: it had been dropped.
    None for any other beacon."""
    relayed = () if last is None else tuple(last.facts.get("relays", "").split())
    is_carried = node.state is NodeState.CARRIED and node.role is Role.BEACON
    if last is None or not relayed or not is_carried or why.code != "unreachable":
        return None
    text = f"{why.reason}; {join_limited(relayed)} reached the base through it {duration(now - last.seen_s)} ago"
    where = f"meshctl deployed {node.name}, and {last_place_hint(last)}"
    hint = f"if it was dropped: {where}; if it is back on its robot: power it on there once"
    return Alarm(Level.WARNING, "dropped", text, hint)


def sighting_text(heard_by: Sequence[Sighting]) -> str:
    """`b02 hears it (-63 dBm, 0.4 s ago), and 2 others`; empty if no node does."""
    if not heard_by:
        return ""
    first = heard_by[0]
    signal = "" if first.signal_dbm is None else f"{first.signal_dbm} dBm, "
    others = f", and {counted(len(heard_by) - 1, 'other')}" if len(heard_by) > 1 else ""
    return f"{first.by} hears it ({signal}{first.age_ms / 1000:.1f} s ago){others}"


def last_place_hint(last: LastKnown) -> str:
    """Where to find an unreachable device, and what to check."""
    via, hops = last.facts.get("via", ""), last.facts.get("hops", "")
    where = f"it was {counted(int(hops), 'hop')} away, behind {via}: " if via else ""
    return f"{where}check power and antenna there" if where else "check power, cable and antenna"
