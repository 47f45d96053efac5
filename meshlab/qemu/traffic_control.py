"""What a receiver does not hear: traffic control on its radio's ingress, by the sender's MAC address.

Frames from each sender pass through an intermediate device (`ifb`) with a class of their own, and netem there loses,
delays and slows them. 802.11 repeats a unicast frame that nobody acknowledged and a broadcast never, so unicast frames
are lost with the probability that every attempt is: hwsim itself loses nothing.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

from meshlab.errors import LabError
from meshlab.qemu.hwsim_devices import run

# attempts of a rate-control series for one unicast frame: mac80211 asks for up to seven (dot11ShortRetryLimit)
_ATTEMPTS = 7
# so much that the class itself never slows anything
_CLASS_RATE = "10gbit"
# below it netem's own loss rounds to nothing
_MIN_LOSS = 1e-6
_QUEUE_PACKETS = 1000


@dataclass(frozen=True, slots=True)
class Impairment:
    """`loss` 0..1 of frames at one attempt; `delay_ms` one way; `rate_kbps` None: unlimited."""

    loss: float = 0.0
    delay_ms: float = 0.0
    rate_kbps: int | None = None

    @property
    def is_none(self) -> bool:
        return not self.loss and not self.delay_ms and self.rate_kbps is None


def ifb_name(interface: str) -> str:
    """The intermediate device of a radio interface; the kernel takes 15 characters."""
    return f"air-{interface}"[:15]


def batch(interface: str, heard: Mapping[str, Impairment]) -> str:
    """`tc -batch` lines for one interface on which frames from these MAC addresses are lost; empty for none."""
    if not heard:
        return ""
    device = ifb_name(interface)
    lines = [
        f"qdisc add dev {interface} handle ffff: ingress",
        f"filter add dev {interface} parent ffff: matchall action mirred egress redirect dev {device}",
        f"qdisc add dev {device} root handle 1: htb default 0",
    ]
    for number, (mac, impairment) in enumerate(sorted(heard.items())):
        group, single = 2 * number + 2, 2 * number + 3
        lines += _class(device, group, impairment, impairment.loss) + _class(
            device, single, impairment, impairment.loss**_ATTEMPTS
        )
        lines += [
            f"filter add dev {device} parent 1: prio 1 protocol all flower src_mac {mac} "
            f"dst_mac 01:00:00:00:00:00/01:00:00:00:00:00 classid 1:{group:x}",
            f"filter add dev {device} parent 1: prio 2 protocol all flower src_mac {mac} classid 1:{single:x}",
        ]
    return "".join(f"{line}\n" for line in lines)


def _class(device: str, number: int, impairment: Impairment, loss: float) -> list[str]:
    words = [f"limit {_QUEUE_PACKETS}"]
    if impairment.delay_ms:
        words.append(f"delay {impairment.delay_ms:g}ms")
    if loss >= _MIN_LOSS:
        words.append(f"loss {100 * loss:.4f}%")
    if impairment.rate_kbps is not None:
        words.append(f"rate {impairment.rate_kbps}kbit")
    return [
        f"class add dev {device} parent 1: classid 1:{number:x} htb rate {_CLASS_RATE}",
        f"qdisc add dev {device} parent 1:{number:x} netem {' '.join(words)}",
    ]


def clear(pid: int, interface: str) -> None:
    """Take away what `put` did to an interface of the node (its process 1); quiet when there is nothing."""
    for words in (("tc", "qdisc", "del", "dev", interface, "ingress"), ("ip", "link", "del", ifb_name(interface))):
        with contextlib.suppress(LabError):
            run(words, node=pid)


def apply(pid: int, interface: str, lines: str) -> None:
    """Apply `batch`'s lines in the network of the node. Raises LabError."""
    device = ifb_name(interface)
    run(("ip", "-batch", "-"), stdin=f"link add dev {device} type ifb\nlink set {device} up\n", node=pid)
    run(("tc", "-batch", "-"), stdin=lines, node=pid)


def originators(pid: int) -> list[str]:
    """The MAC addresses that the batman-adv of a node (its process 1) has a route to; none while it has no mesh."""
    try:
        known = json.loads(run(("batctl", "meshif", "bat0", "originators_json"), node=pid))
    except (LabError, json.JSONDecodeError):
        return []
    return [str(one["orig_address"]) for one in known if one.get("best")]
