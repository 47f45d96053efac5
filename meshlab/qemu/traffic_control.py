"""Link impairments as traffic control on the ingress of the receiving radio, by the sender's MAC address.

Frames of each sender pass through classes of an intermediate device (`ifb`), where netem drops and delays them.
802.11 retransmits unacknowledged unicast frames but never broadcasts, so a unicast frame is dropped with the
probability that every attempt is lost: hwsim itself loses nothing.

On a link with a rate, broadcasts and unicast frames share one channel. A broadcast, which 802.11 sends at a low basic
rate, takes as long as several unicast frames of its length: copies of it go through the channel before it. They are
mirrored, not redirected, and `ifb` drops mirrored frames when they leave the queue.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

from meshlab.errors import LabError
from meshlab.qemu.hwsim_devices import run

# transmissions of a unicast frame: mac80211 makes up to seven (dot11ShortRetryLimit)
_ATTEMPTS = 7
# so high that the class itself never limits the rate
_CLASS_RATE = "10gbit"
# a class that only gets what the channel has left
_MIN_RATE = "8bit"
# netem rounds a smaller loss to 0
_MIN_LOSS = 1e-6
_QUEUE_PACKETS = 1000
# the longest frame of a mesh radio
_FRAME_BYTES = 1600
# a filter has at most 32 actions, and each copy costs the machine time
MAX_BROADCAST_COPIES = 24


@dataclass(frozen=True, slots=True)
class Impairment:
    """`loss` 0..1 per transmission; `delay_ms` one way; `rate_kbps` None: unlimited. `broadcast_kbps` None: broadcasts
    have the link's rate."""

    loss: float = 0.0
    delay_ms: float = 0.0
    rate_kbps: int | None = None
    broadcast_kbps: int | None = None

    @property
    def is_none(self) -> bool:
        return not self.loss and not self.delay_ms and self.rate_kbps is None

    @property
    def broadcast_copies(self) -> int:
        """How many unicast frames of its length take as long as a broadcast."""
        if self.rate_kbps is None or self.broadcast_kbps is None:
            return 1
        return max(1, min(MAX_BROADCAST_COPIES, round(self.rate_kbps / self.broadcast_kbps)))


def ifb_name(interface: str) -> str:
    """The intermediate device of a radio interface; names are limited to 15 characters."""
    return f"air-{interface}"[:15]


def batch(interface: str, heard: Mapping[str, Impairment]) -> str:
    """`tc -batch` lines for one interface that impair frames from these MAC addresses; empty for none."""
    if not heard:
        return ""
    device = ifb_name(interface)
    lines = [f"qdisc add dev {interface} handle ffff: ingress"]
    lines += [_copies(interface, mac, heard[mac]) for mac in sorted(heard) if heard[mac].broadcast_copies > 1]
    lines += [
        f"filter add dev {interface} parent ffff: prio 2 protocol all matchall "
        f"action mirred egress redirect dev {device}",
        f"qdisc add dev {device} root handle 1: htb default 0",
    ]
    for number, (mac, impairment) in enumerate(sorted(heard.items())):
        lines += _classes(device, number, impairment)
        group, single = _group_and_single(number)
        lines += [
            f"filter add dev {device} parent 1: prio 1 protocol all flower src_mac {mac} "
            f"dst_mac {_GROUP_ADDRESSES} classid 1:{group:x}",
            f"filter add dev {device} parent 1: prio 2 protocol all flower src_mac {mac} classid 1:{single:x}",
        ]
    return "".join(f"{line}\n" for line in lines)


_GROUP_ADDRESSES = "01:00:00:00:00:00/01:00:00:00:00:00"


def _group_and_single(number: int) -> tuple[int, int]:
    """The classes of a sender's broadcasts and of its unicast frames; the one below is their channel."""
    return 3 * number + 3, 3 * number + 4


def _copies(interface: str, mac: str, impairment: Impairment) -> str:
    """The filter that lets a sender's broadcasts take their time: the copies first, as a frame arrives at its end."""
    mirror, redirect = (f"action mirred egress {how} dev {ifb_name(interface)}" for how in ("mirror", "redirect"))
    words = [*[mirror] * (impairment.broadcast_copies - 1), redirect]
    return (
        f"filter add dev {interface} parent ffff: prio 1 protocol all flower src_mac {mac} dst_mac {_GROUP_ADDRESSES} "
        f"{' '.join(words)}"
    )


def _classes(device: str, number: int, impairment: Impairment) -> list[str]:
    """Both classes of a sender, with netem; with a rate, they take turns on their channel, each for the same time."""
    group, single = _group_and_single(number)
    parent, rate, lines = "1:", f"rate {_CLASS_RATE}", []
    if impairment.rate_kbps is not None:
        parent = f"1:{group - 1:x}"
        channel = f"ceil {impairment.rate_kbps}kbit burst {_FRAME_BYTES} cburst {_FRAME_BYTES}"
        turn = _FRAME_BYTES * impairment.broadcast_copies
        lines.append(f"class add dev {device} parent 1: classid {parent} htb rate {impairment.rate_kbps}kbit {channel}")
        rate = f"rate {_MIN_RATE} {channel} quantum {turn}"
    for place, loss in ((group, impairment.loss), (single, impairment.loss**_ATTEMPTS)):
        lines += [
            f"class add dev {device} parent {parent} classid 1:{place:x} htb {rate}",
            f"qdisc add dev {device} parent 1:{place:x} netem {_netem(impairment, loss)}",
        ]
    return lines


def _netem(impairment: Impairment, loss: float) -> str:
    words = [f"limit {_QUEUE_PACKETS}"]
    if impairment.delay_ms:
        words.append(f"delay {impairment.delay_ms:g}ms")
    if loss >= _MIN_LOSS:
        words.append(f"loss {100 * loss:.4f}%")
    if impairment.rate_kbps is not None:
        # the time that a frame itself takes; the channel adds what others take
        words.append(f"rate {impairment.rate_kbps}kbit")
    return " ".join(words)


def clear(pid: int, interface: str) -> None:
    """Undo `apply` on an interface of the node (its process 1); does nothing if there is nothing to undo."""
    for words in (("tc", "qdisc", "del", "dev", interface, "ingress"), ("ip", "link", "del", ifb_name(interface))):
        with contextlib.suppress(LabError):
            run(words, node=pid)


def apply(pid: int, interface: str, lines: str) -> None:
    """Apply the lines of `batch` in the node's network namespace. Raises LabError."""
    device = ifb_name(interface)
    run(("ip", "-batch", "-"), stdin=f"link add dev {device} type ifb\nlink set {device} up\n", node=pid)
    run(("tc", "-batch", "-"), stdin=lines, node=pid)


def originators(pid: int) -> list[str]:
    """The MAC addresses to which the batman-adv of a node (its process 1) has a route; empty without a mesh."""
    try:
        known = json.loads(run(("batctl", "meshif", "bat0", "originators_json"), node=pid))
    except (LabError, json.JSONDecodeError):
        return []
    return [str(originator["orig_address"]) for originator in known if originator.get("best")]
