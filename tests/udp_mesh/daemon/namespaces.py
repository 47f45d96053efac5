"""Two real daemons, each in a network namespace of its own, joined by veth pairs that are added, removed and changed.

`python -m tests.udp_mesh.daemon.namespaces SCENARIO` plays one of the functions below; it must run as root of a network
namespace of its own (`unshare --net`). Anything that is not as it should be raises.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.udp_mesh.daemon.processes import KEY, RATES, RunningDaemon, collect, outcomes, poll, wait_online
from tests.udp_mesh.daemon.veth_links import ip
from udp_mesh.cli.views import status_view

MAP_BYTES = 3_000_000
"""Takes some seconds at the topic's rate limit: time to change the network during the transfer."""


class Pair:
    """Alice and bob; `join` connects them."""

    def __init__(self, alice: RunningDaemon, bob: RunningDaemon) -> None:
        self.alice, self.bob = alice, bob

    def ip(self, daemon: RunningDaemon, words: str) -> None:
        """`ip WORDS` in the daemon's namespace."""
        ip(daemon, words)

    def join(self, interface: str) -> None:
        """A veth pair with one end, named so, in each namespace; both up."""
        assert self.alice.process is not None
        assert self.bob.process is not None
        words = f"link add {interface} netns {self.alice.process.pid} type veth peer name {interface}"
        subprocess.run(["ip", *words.split(), "netns", str(self.bob.process.pid)], check=True)
        for daemon in (self.alice, self.bob):
            self.ip(daemon, f"link set {interface} up")

    def addresses(self) -> dict[str, str]:
        """Peer -> the address its messages go to, as each daemon reports it."""
        found: dict[str, str] = {}
        for daemon in (self.alice, self.bob):
            with daemon.client() as client:
                found |= {peer["name"]: peer["address"] for peer in client.request("peers")["peers"]}
        return found

    def exchange(self) -> None:
        """Both ways, reliably, a small message and one of many fragments."""
        for source, target in ((self.alice, self.bob), (self.bob, self.alice)):
            with source.client() as sender, target.client() as receiver:
                receiver.subscribe("*")
                for topic, payload in (("status", b"ready"), ("map", bytes(100_000))):
                    sender.publish(topic, payload, to=target.name, notify=True)
                    (message,) = collect(receiver, 1)
                    assert (message.source, message.topic, message.payload) == (source.name, topic, payload)
                assert set(outcomes(sender, 2).values()) == {"delivered"}


@contextmanager
def pair(*more: str) -> Iterator[Pair]:
    """Both daemons up, not yet joined; `more` is appended to the configuration of each."""
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder = Path(path)
        (folder / "key").write_text(KEY + "\n")
        daemons = []
        for name, own in zip(("alice", "bob"), more or ("", ""), strict=True):
            configuration = f"""
name = "{name}"
key_file = "{folder}/key"
[topics]
status = {{ priority = 0 }}
map = {{ priority = 7, rate_limit_bytes_per_s = 1000000 }}
{RATES}
{own}
[daemon]
socket = "{folder / name}.sock"
state_directory = "{folder / name}"
"""
            daemon = RunningDaemon(folder, name, configuration)
            # No duplicate address detection needed on a veth pair
            no_check = "echo 0 > /proc/sys/net/ipv6/conf/default/accept_dad"
            daemon.prefix = ["unshare", "--net", "sh", "-c", f'{no_check}; exec "$@"', "sh"]
            daemons.append(daemon)
        with daemons[0], daemons[1]:
            yield Pair(*daemons)


def met(both: Pair) -> None:
    wait_online(both.alice, "bob")
    wait_online(both.bob, "alice")


# ---- scenarios


def ipv6_only() -> None:
    """Without any IPv4 address they discover each other over the all-nodes group, lose contact, and reconnect."""
    with pair() as both:
        both.join("mesh0")
        met(both)
        assert all(address.startswith("[fe80::") for address in both.addresses().values()), both.addresses()
        both.exchange()
        both.ip(both.alice, "link set mesh0 down")
        wait_online(both.bob, "alice", online=False)
        both.ip(both.alice, "link set mesh0 up")
        met(both)
        both.exchange()


def ipv6_neighbours() -> None:
    """Fixed neighbors with routable addresses, which appear after the link-local ones."""
    link = '[[links]]\ninterface = "mesh0"\nkind = "neighbours"\n[[neighbours]]\naddress = '
    with pair(f'{link}"fd00::2"\n', f'{link}"[fd00::1]:8700"\n') as both:
        both.join("mesh0")
        both.ip(both.alice, "addr add fd00::1/64 dev mesh0 nodad")
        both.ip(both.bob, "addr add fd00::2/64 dev mesh0 nodad")
        met(both)
        # They may hear each other from the link-local ones first.
        expected = {"alice": "[fd00::1]:8700", "bob": "[fd00::2]:8700"}
        poll(lambda: both.addresses() == expected, f"peers at {expected}")
        both.exchange()


def ipv6_address_with_broadcast() -> None:
    """The links that meshctl renders in an IPv6 network: one routable address, discovery over the all-nodes group."""
    link = '[[links]]\nkind = "broadcast"\naddress = '
    with pair(f'{link}"fd42::1"\n', f'{link}"fd42::2"\n') as both:
        both.join("mesh0")
        both.ip(both.alice, "addr add fd42::1/64 dev mesh0 nodad")
        both.ip(both.bob, "addr add fd42::2/64 dev mesh0 nodad")
        met(both)
        both.exchange()


def two_ipv6_links() -> None:
    """Link-local addresses are valid on one interface only: each link uses its own."""
    with pair() as both:
        both.join("mesh0")
        met(both)
        both.join("mesh1")
        both.exchange()
        both.ip(both.bob, "link del mesh0")
        poll(lambda: link_of(both.alice, "bob") == "mesh1", "alice reaches bob over mesh1")
        met(both)
        both.exchange()


def ipv4_beside_ipv6() -> None:
    """An IPv4 address that appears later is used from then on."""
    with pair() as both:
        both.join("mesh0")
        met(both)
        for number, daemon in enumerate((both.alice, both.bob), 1):
            both.ip(daemon, f"addr add 10.7.20.{number}/20 broadcast + dev mesh0")
        wanted = {"alice": "10.7.20.1:8700", "bob": "10.7.20.2:8700"}
        poll(lambda: both.addresses() == wanted, "both are reached over IPv4")
        both.exchange()


def addresses_without_broadcast() -> None:
    """One was given its address with a broadcast address, the other (`ip addr add` alone) without: they meet over
    IPv4."""
    with pair() as both:
        both.join("mesh0")
        both.ip(both.alice, "addr add 10.7.20.1/20 broadcast + dev mesh0")
        both.ip(both.bob, "addr add 10.7.20.2/20 dev mesh0")
        wanted = {"alice": "10.7.20.1:8700", "bob": "10.7.20.2:8700"}
        poll(lambda: both.addresses() == wanted, "both are reached over IPv4")
        met(both)
        both.exchange()


def address_changes_in_the_middle() -> None:
    """A map in transfer follows bob to another address and another subnet, and arrives once."""
    with pair() as both:
        both.join("mesh0")
        for number, daemon in enumerate((both.alice, both.bob), 1):
            both.ip(daemon, f"addr add 10.7.20.{number}/20 broadcast + dev mesh0")
        met(both)
        with both.alice.client() as sender, both.bob.client() as receiver:
            receiver.subscribe("map")
            sender.publish("map", bytes(MAP_BYTES), to="bob", notify=True)
            under_way(both.alice, 300)
            both.ip(both.bob, "addr del 10.7.20.2/20 dev mesh0")
            both.ip(both.bob, "addr add 10.7.20.77/20 broadcast + dev mesh0")
            poll(lambda: both.addresses()["bob"] == "10.7.20.77:8700", "alice follows bob")
            under_way(both.alice, 800)
            for number, daemon in enumerate((both.alice, both.bob), 1):
                both.ip(daemon, "addr flush dev mesh0 scope global")
                both.ip(daemon, f"addr add 192.168.9.{number}/28 broadcast + dev mesh0")
            wanted = {"alice": "192.168.9.1:8700", "bob": "192.168.9.2:8700"}
            poll(lambda: both.addresses() == wanted, "both follow into the other subnet")
            (message,) = collect(receiver, 1)
            assert message.payload == bytes(MAP_BYTES)
            assert list(outcomes(sender, 1).values()) == ["delivered"]
            assert receiver.next_frame(1.0) is None


def interface_goes_in_the_middle() -> None:
    """The interface is removed during a transfer and another one appears: the transfer continues there."""
    with pair() as both:
        both.join("mesh0")
        met(both)
        with both.alice.client() as sender, both.bob.client() as receiver:
            receiver.subscribe("map")
            sender.publish("map", bytes(MAP_BYTES), to="bob", notify=True)
            under_way(both.alice, 300)
            both.ip(both.alice, "link del mesh0")
            both.join("mesh1")
            (message,) = collect(receiver, 1)
            assert message.payload == bytes(MAP_BYTES)
            assert list(outcomes(sender, 1).values()) == ["delivered"]
            assert link_of(both.alice, "bob") == "mesh1"


def interface_created_again() -> None:
    """Deleted and created again at once with the same name and address, as by a driver reload or a script."""
    with pair() as both:
        both.join("mesh0")
        for number, daemon in enumerate((both.alice, both.bob), 1):
            both.ip(daemon, f"addr add 10.7.20.{number}/20 broadcast + dev mesh0")
        met(both)
        pids = [daemon.process.pid for daemon in (both.alice, both.bob) if daemon.process is not None]
        alice, bob = (f"nsenter -t {pid} -n ip" for pid in pids)
        steps = [
            f"{alice} link del mesh0",
            f"ip link add mesh0 netns {pids[0]} type veth peer name mesh0 netns {pids[1]}",
            *(
                f"{ip} {words}"
                for number, ip in enumerate((alice, bob), 1)
                for words in (f"addr add 10.7.20.{number}/20 broadcast + dev mesh0", "link set mesh0 up")
            ),
        ]
        subprocess.run(["sh", "-ec", "\n".join(steps)], check=True)
        both.exchange()


def interface_too_narrow() -> None:
    """An interface too narrow for any datagram is reported; the others keep working."""
    with pair() as both:
        both.join("mesh0")
        both.join("narrow0")
        for number, daemon in enumerate((both.alice, both.bob), 1):
            both.ip(daemon, f"addr add 10.7.20.{number}/20 broadcast + dev mesh0")
            both.ip(daemon, "link set narrow0 mtu 150")
            both.ip(daemon, f"addr add 10.8.0.{number}/24 broadcast + dev narrow0")
        for daemon in (both.alice, both.bob):
            logged(daemon, "link-failed link=narrow0 reason=expected an MTU of at least 200 bytes, found 150")
        met(both)
        both.exchange()


def interface_narrows_after_sending() -> None:
    """A message was sent completely and lost when the interface's MTU shrinks: under another number it could arrive
    twice, so it keeps its fragments, which the kernel cuts."""
    with pair() as both:
        both.join("mesh0")
        for number, daemon in enumerate((both.alice, both.bob), 1):
            both.ip(daemon, f"addr add 10.7.20.{number}/20 broadcast + dev mesh0")
        met(both)
        with both.alice.client() as sender, both.bob.client() as receiver:
            receiver.subscribe("map")
            both.ip(both.bob, "xfrm policy add dir in src 10.7.20.1/32 action block")
            sender.publish("map", bytes(5000), to="bob", notify=True)
            under_way(both.alice, 4)
            for daemon in (both.alice, both.bob):
                both.ip(daemon, "link set mesh0 mtu 1000")
            poll(lambda: mtu_of(both.alice, "mesh0") == 1000, "alice knows the new MTU")
            both.ip(both.bob, "xfrm policy flush")
            (message,) = collect(receiver, 1)
            assert message.payload == bytes(5000)
            assert list(outcomes(sender, 1).values()) == ["delivered"]
        both.exchange()
        assert "Message too long" not in both.alice.log.read_text()


def sending_is_forbidden() -> None:
    """A firewall rule drops traffic to one peer, then to all: it is logged with reason and peers; without it, traffic
    resumes and arrives once."""
    with pair() as both:
        both.join("mesh0")
        for number, daemon in enumerate((both.alice, both.bob), 1):
            both.ip(daemon, f"addr add 10.7.20.{number}/20 broadcast + dev mesh0")
        met(both)
        for forbidden in ("10.7.20.2/32", "0.0.0.0/0"):
            with both.alice.client() as sender, both.bob.client() as receiver:
                receiver.subscribe("*")
                both.ip(both.alice, f"xfrm policy add dir out dst {forbidden} action block")
                sender.publish("map", bytes(300_000), to="bob", notify=True)
                sender.publish("status", b"urgent", to="bob", notify=True)
                (refusal,) = poll(lambda: sender.request("status")["refusals"] or None, "alice tells what is refused")
                assert (refusal["link"], refusal["reason"]) == ("mesh0", "Operation not permitted")
                assert "10.7.20.2:8700" in refusal["to"]
                assert "link mesh0 CANNOT SEND to 10.7.20.2:8700" in status_view(sender.request("status"))
                assert receiver.next_frame(1.0) is None
                both.ip(both.alice, "xfrm policy flush")
                assert [message.topic for message in collect(receiver, 2)] == ["status", "map"]
                assert set(outcomes(sender, 2).values()) == {"delivered"}
                assert receiver.next_frame(0.5) is None
        logged(both.alice, "send-refused link=mesh0 to=10.7.20.2:8700 ")


def interface_queue_overflows() -> None:
    """A queue of two datagrams in front of the interface drops most of what leaves (the kernel says nothing of it, or
    ENOBUFS): everything arrives, once."""
    with pair() as both:
        both.join("mesh0")
        for number, daemon in enumerate((both.alice, both.bob), 1):
            both.ip(daemon, f"addr add 10.7.20.{number}/20 broadcast + dev mesh0")
        met(both)
        assert both.alice.process is not None
        words = "qdisc add dev mesh0 root tbf rate 8mbit burst 3000 limit 3000"
        subprocess.run(["nsenter", "-t", str(both.alice.process.pid), "-n", "tc", *words.split()], check=True)
        with both.alice.client() as sender, both.bob.client() as receiver:
            receiver.subscribe("*")
            sender.publish("map", bytes(1_000_000), to="bob", notify=True)
            for number in range(20):
                sender.publish("status", b"%d" % number, to="bob", notify=True)
            sent = {bytes(1_000_000), *(b"%d" % number for number in range(20))}
            assert {message.payload for message in collect(receiver, 21)} == sent
            assert set(outcomes(sender, 21).values()) == {"delivered"}


def logged(daemon: RunningDaemon, text: str) -> None:
    """Waits for a text in the daemon's log."""
    poll(lambda: text in daemon.log.read_text(), f"{daemon.name} logs {text!r}")


def link_of(daemon: RunningDaemon, peer: str) -> str | None:
    with daemon.client() as client:
        return next((found["link"] for found in client.request("peers")["peers"] if found["name"] == peer), None)


def mtu_of(daemon: RunningDaemon, link: str) -> int | None:
    with daemon.client() as client:
        return next((found["mtu"] for found in client.request("status")["links"] if found["name"] == link), None)


def under_way(daemon: RunningDaemon, fragments: int) -> None:
    """Waits until this many fragments were sent."""

    def sent() -> bool:
        with daemon.client() as client:
            return bool(client.request("status")["conditions"]["counters"]["fragments_sent"] >= fragments)

    poll(sent, f"{fragments} fragments have left {daemon.name}")


SCENARIOS: dict[str, Callable[[], None]] = {
    scenario.__name__: scenario
    for scenario in (
        ipv6_only,
        ipv6_neighbours,
        ipv6_address_with_broadcast,
        two_ipv6_links,
        ipv4_beside_ipv6,
        addresses_without_broadcast,
        address_changes_in_the_middle,
        interface_goes_in_the_middle,
        interface_created_again,
        interface_too_narrow,
        interface_narrows_after_sending,
        sending_is_forbidden,
        interface_queue_overflows,
    )
}


if __name__ == "__main__":
    SCENARIOS[sys.argv[1]]()
