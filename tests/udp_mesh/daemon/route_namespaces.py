"""Real daemons at both ends of an IPv6 route whose middle link carries less than theirs: alice - r - s - bob.

`python -m tests.udp_mesh.daemon.route_namespaces SCENARIO` plays one of the functions below; it must run as root of a
network namespace of its own (`unshare --net`). IPv6, because a router cuts no IPv6 packets, and the daemons believe no
ICMP error: they have to find out by themselves. Anything that is not as it should be raises.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.udp_mesh.daemon.namespaces import Pair, logged, met, under_way
from tests.udp_mesh.daemon.processes import KEY, RATES, collect, outcomes
from tests.udp_mesh.daemon.veth_links import isolated_daemon
from udp_mesh.cli.views import status_view

NARROW_MTU = 1280
TOPICS = """
status = { priority = 0 }
map = { priority = 7, rate_limit_bytes_per_s = 1000000 }
"""
MAP_BYTES = 2_000_000


class Namespace:
    """A network namespace, kept by a process in it."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def run(self, *words: str) -> None:
        subprocess.run(["nsenter", "-t", str(self.pid), "-n", *words], check=True)

    def ip(self, words: str) -> None:
        self.run("ip", *words.split())


@contextlib.contextmanager
def router() -> Iterator[Namespace]:
    """A namespace that forwards IPv6."""
    forward = "echo 1 > /proc/sys/net/ipv6/conf/all/forwarding && echo ready && exec cat"
    command = ["unshare", "--net", "sh", "-c", forward]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline() == "ready\n"
        yield Namespace(process.pid)
        process.stdin.close()


def join(left: Namespace, right: Namespace, network: int) -> None:
    """A veth pair `link<network>` between two namespaces, with the addresses fd0<network>::1 and ::2."""
    name = f"link{network}"
    words = f"link add {name} netns {left.pid} type veth peer name {name} netns {right.pid}"
    subprocess.run(["ip", *words.split()], check=True)
    for place, namespace in enumerate((left, right), 1):
        namespace.ip(f"addr add fd0{network}::{place}/64 dev {name} nodad")
        namespace.ip(f"link set {name} up")


class Route:
    """Both daemons and the routers between them."""

    def __init__(self, both: Pair, routers: tuple[Namespace, Namespace]) -> None:
        self.both, self.routers = both, routers

    def narrow(self) -> None:
        """The routers report nothing to the daemons but ICMP errors."""
        for each in self.routers:
            each.ip(f"link set link2 mtu {NARROW_MTU}")


@contextlib.contextmanager
def route() -> Iterator[Route]:
    """A route on which alice and bob have not met yet."""
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, contextlib.ExitStack() as stack:
        folder = Path(path)
        (folder / "key").write_text(KEY + "\n")
        daemons = []
        for name, own, other in (("alice", "fd01::1", "fd03::2"), ("bob", "fd03::2", "fd01::1")):
            links = f'[[links]]\nkind = "neighbours"\naddress = "{own}"\n[[neighbours]]\naddress = "[{other}]:8700"\n'
            daemon = isolated_daemon(folder, name, TOPICS, more=RATES + links)
            daemons.append(stack.enter_context(daemon))
        alice, bob = [Namespace(daemon.process.pid) for daemon in daemons if daemon.process is not None]
        r, s = stack.enter_context(router()), stack.enter_context(router())
        join(alice, r, 1)
        join(r, s, 2)
        join(s, bob, 3)
        r.ip("route add fd03::/64 via fd02::2")
        s.ip("route add fd01::/64 via fd02::1")
        alice.ip("route add default via fd01::2")
        bob.ip("route add default via fd03::1")
        yield Route(Pair(*daemons), (r, s))


# ---- scenarios


def narrow_from_the_start() -> None:
    """Messages arrive both ways, and each end finds the MTU rather than the next lower one, and shows it."""
    with route() as narrow:
        narrow.narrow()
        met(narrow.both)
        narrow.both.exchange()
        for daemon, peer in ((narrow.both.alice, "bob"), (narrow.both.bob, "alice")):
            logged(daemon, f"mtu={NARROW_MTU} ")
            with daemon.client() as client:
                page = status_view(client.request("status"))
            assert f"the path to {peer} carries packets of {NARROW_MTU} bytes at most, link " in page


def narrows_in_the_middle() -> None:
    """A map in transfer arrives once although the route narrows."""
    with route() as narrowing:
        both = narrowing.both
        met(both)
        with both.alice.client() as sender, both.bob.client() as receiver:
            receiver.subscribe("map")
            sender.publish("map", bytes(MAP_BYTES), to="bob", notify=True)
            under_way(both.alice, 300)
            assert "the path to" not in status_view(sender.request("status"))
            narrowing.narrow()
            (message,) = collect(receiver, 1)
            assert message.payload == bytes(MAP_BYTES)
            assert list(outcomes(sender, 1).values()) == ["delivered"]
        both.exchange()
        logged(both.alice, f"mtu={NARROW_MTU} ")


SCENARIOS: dict[str, Callable[[], None]] = {
    scenario.__name__: scenario for scenario in (narrow_from_the_start, narrows_in_the_middle)
}


if __name__ == "__main__":
    SCENARIOS[sys.argv[1]]()
