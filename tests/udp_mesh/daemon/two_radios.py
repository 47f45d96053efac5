"""Two real daemons that two radios join, of which one is cut: `python -m tests.udp_mesh.daemon.two_radios`.

It must run as root of a network namespace of its own (`unshare --net`). Anything that is not as it should be raises.
"""

from __future__ import annotations

import subprocess

from tests.udp_mesh.daemon.namespaces import Pair, link_of, met, pair, under_way
from tests.udp_mesh.daemon.processes import collect, outcomes, poll

RADIOS = {"mesh0": "10.7.20", "mesh1": "10.8.20"}
MAP_BYTES = 6_000_000


def cut(both: Pair, radio: str) -> None:
    """Nothing passes any more, although both interfaces are up: no packet fits the queue's burst."""
    _tc(both, f"qdisc add dev {radio} root tbf rate 8kbit burst 20 limit 20")


def restore(both: Pair, radio: str) -> None:
    _tc(both, f"qdisc del dev {radio} root")


def _tc(both: Pair, words: str) -> None:
    for daemon in (both.alice, both.bob):
        assert daemon.process is not None
        subprocess.run(["nsenter", "-t", str(daemon.process.pid), "-n", "tc", *words.split()], check=True)


def main() -> None:
    """The radio in use is cut: a map in transfer moves to the other one. The first comes back with another address, and
    has the traffic again when the second is cut."""
    with pair() as both:
        for radio, network in RADIOS.items():
            both.join(radio)
            for number, daemon in enumerate((both.alice, both.bob), 1):
                both.ip(daemon, f"addr add {network}.{number}/24 broadcast + dev {radio}")
        met(both)
        in_use = link_of(both.alice, "bob")
        assert in_use in RADIOS
        (other,) = RADIOS.keys() - {in_use}
        with both.alice.client() as sender, both.bob.client() as receiver:
            receiver.subscribe("map")
            sender.publish("map", bytes(MAP_BYTES), to="bob", notify=True)
            under_way(both.alice, 300)
            cut(both, in_use)
            poll(lambda: link_of(both.alice, "bob") == other, f"alice reaches bob over {other}")
            both.ip(both.bob, f"addr flush dev {in_use} scope global")
            both.ip(both.bob, f"addr add {RADIOS[in_use]}.77/24 broadcast + dev {in_use}")
            restore(both, in_use)
            under_way(both.alice, 2000)
            cut(both, other)
            poll(lambda: both.addresses()["bob"] == f"{RADIOS[in_use]}.77:8700", "alice reaches bob's new address")
            (message,) = collect(receiver, 1)
            assert message.payload == bytes(MAP_BYTES)
            assert list(outcomes(sender, 1).values()) == ["delivered"]
            assert receiver.next_frame(1.0) is None


if __name__ == "__main__":
    main()
