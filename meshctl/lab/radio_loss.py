"""What a node misses of each neighbour, as tc commands for its network namespace: netem per sender, by source MAC.

`prepare` once per namespace, `receive` for each radio interface whenever it has been made anew, `changes` whenever
losses change; `batch` turns each into the input of `ip -batch` and `tc -batch`.

A broadcast leaves its sender once for all who hear it, so what one of them misses must be lost where it arrives:
frames that a radio receives are redirected to an ifb device, sorted there by source MAC (u32 filters) into classes of
an HTB that never slows anything, and lost by the netem of their class. Who is in no class passes untouched.

802.11 sends a unicast frame again until it is acknowledged and a broadcast only once, so each sender has two classes:
broadcasts are lost as told, and unicast frames as seldom as all attempts together are. The radios below have
acknowledged everything already, hwsim loses nothing.

Devices and numbers: `ifb0`; HTB 1:; for the sender with number N, classes 1:2N+1 (broadcasts) and 1:2N+2 (unicast),
netem 2N+16: and 2N+17:, filters 800::(16N + 2k + 1) and the next for its k-th MAC. tc writes numbers in hexadecimal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

Command = tuple[str, ...]
"""A program and its words: `("tc", "qdisc", "add", ...)`."""

DEVICE = "ifb0"
# filters are numbered with 12 bits, of which a sender takes 4 and each of its MACs two filters
_MACS = 7
_SENDERS = 255
# how often a unicast frame is sent at most: dot11ShortRetryLimit's default of 7 (IEEE 802.11-2020, annex C)
_ATTEMPTS = 7
# matches a destination's group bit, the lowest of the frame's first byte, 14 before the network header
_BROADCAST, _UNICAST = "match u8 0x01 0x01 at -14", "match u8 0x00 0x01 at -14"
# faster than any radio, so that only netem ever holds a frame back
_ENDLESS_RATE = "10gbit"
# frames that wait in netem for their delay: 12 Mbit/s for a second
_QUEUE_FRAMES = 1000


@dataclass(frozen=True, slots=True)
class Missing:
    """What happens to frames from the sender with these MACs: `loss` 0..1 at one attempt, `rate_kbps` None: endless."""

    macs: tuple[str, ...]
    loss: float = 0.0
    delay_ms: float = 0.0
    rate_kbps: int | None = None

    @property
    def is_nothing(self) -> bool:
        return self.loss <= 0.0 and self.delay_ms <= 0.0 and self.rate_kbps is None


def prepare() -> list[Command]:
    """For a namespace that has just been made."""
    return [
        ("ip", "link", "add", DEVICE, "type", "ifb"),
        ("ip", "link", "set", DEVICE, "up"),
        _tc("qdisc", "add", "root handle 1: htb default 0", f"direct_qlen {_QUEUE_FRAMES}"),
    ]


def receive(interface: str) -> list[Command]:
    """For a radio interface that has just been made: what it hears takes the way through the ifb device."""
    return [
        ("tc", "qdisc", "add", "dev", interface, "ingress"),
        ("tc", "filter", "add", "dev", interface, "ingress", "protocol", "all", "prio", "1", "u32", "match", "u32",
         "0", "0", "action", "mirred", "egress", "redirect", "dev", DEVICE),
    ]  # fmt: skip


def changes(old: Mapping[int, Missing], new: Mapping[int, Missing]) -> list[Command]:
    """From one table of senders (by number, from 0) to another; frames of senders that stay the same are not touched.

    Raises ValueError for a sender with too high a number or too many MACs.
    """
    for number, sender in new.items():
        if not 0 <= number < _SENDERS or not 1 <= len(sender.macs) <= _MACS:
            raise ValueError(f"sender {number} with {len(sender.macs)} MACs: at most {_SENDERS} with {_MACS} each")
    before = {number: sender for number, sender in old.items() if not sender.is_nothing}
    after = {number: sender for number, sender in new.items() if not sender.is_nothing}
    commands: list[Command] = []
    for number, sender in before.items():
        if number not in after or after[number].macs != sender.macs:
            commands += _without(number, sender)
    for number, sender in after.items():
        known = before.get(number)
        if known is None or known.macs != sender.macs:
            commands += _with(number, sender)
        elif known != sender:
            commands += [_netem("change", number, kind, sender) for kind in (0, 1)]
    return commands


def batch(commands: list[Command], program: str) -> str:
    """The words of the commands that `program` (`ip` or `tc`) is to run, one command per line, for its `-batch -`."""
    return "".join(" ".join(words) + "\n" for first, *words in commands if first == program)


def _with(number: int, sender: Missing) -> list[Command]:
    commands = []
    for kind in (0, 1):
        commands += [
            _tc("class", "add", f"parent 1: classid {_class(number, kind)} htb rate {_ENDLESS_RATE} quantum 60000"),
            _netem("add", number, kind, sender),
        ]
    for count, mac in enumerate(sender.macs):
        commands += [
            _tc("filter", "add", _filter(number, count, kind), to, _from(mac), f"flowid {_class(number, kind)}")
            for kind, to in enumerate((_BROADCAST, _UNICAST))
        ]
    return commands


def _without(number: int, sender: Missing) -> list[Command]:
    filters = [
        _tc("filter", "del", _filter(number, count, kind)) for count in range(len(sender.macs)) for kind in (0, 1)
    ]
    return [*filters, *(_tc("class", "del", f"classid {_class(number, kind)}") for kind in (0, 1))]


def _netem(verb: str, number: int, kind: int, sender: Missing) -> Command:
    loss = sender.loss ** (_ATTEMPTS if kind else 1)
    return _tc(
        "qdisc", verb, f"parent {_class(number, kind)} handle {number * 2 + 16 + kind:x}:",
        f"netem limit {_QUEUE_FRAMES}",
        f"loss {loss * 100:.6f}% delay {sender.delay_ms:g}ms",
        f"rate {sender.rate_kbps}kbit" if sender.rate_kbps is not None else "",
    )  # fmt: skip


def _class(number: int, kind: int) -> str:
    return f"1:{number * 2 + 1 + kind:x}"


def _filter(number: int, count: int, kind: int) -> str:
    return f"parent 1: protocol all prio 1 handle 800::{number * 16 + count * 2 + kind + 1:x} u32"


def _from(mac: str) -> str:
    """Matches a frame's source MAC, which lies 8 bytes before the network header."""
    digits = mac.replace(":", "").lower()
    return f"match u32 0x{digits[:8]} 0xffffffff at -8 match u16 0x{digits[8:]} 0xffff at -4"


def _tc(kind: str, verb: str, *words: str) -> Command:
    return ("tc", kind, verb, "dev", DEVICE, *" ".join(words).split())
