"""Link impairments as traffic control on the ingress of the receiving radio, by the sender's MAC address.

Frames of each sender pass through a class of an intermediate device (`ifb`), where netem drops, delays and slows them.
802.11 retransmits unacknowledged unicast frames but never broadcasts, so a unicast frame is dropped with the
probability that every attempt is lost: hwsim itself loses nothing.
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
# netem rounds a smaller loss to 0
_MIN_LOSS = 1e-6
_QUEUE_PACKETS = 1000


@dataclass(frozen=True, slots=True)
class Impairment:
    """`loss` 0..1 per transmission; `delay_ms` one way; `rate_kbps` None: unlimited."""

    loss: float = 0.0
    delay_ms: float = 0.0
    rate_kbps: int | None = None

    @property
    def is_none(self) -> bool:
        return not self.loss and not self.delay_ms and self.rate_kbps is None


def ifb_name(interface: str) -> str:
    """The intermediate device of a radio interface; names are limited to 15 characters."""
    return f"air-{interface}"[:15]


def batch(interface: str, heard: Mapping[str, Impairment]) -> str:
    """`tc -batch` lines for one interface that impair frames from these MAC addresses; empty for none."""
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
