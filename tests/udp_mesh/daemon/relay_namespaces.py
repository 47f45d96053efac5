"""Real daemons in a chain, each in a network namespace of its own: alice - relay - bob, and a second relay beside it.

`python -m tests.udp_mesh.daemon.relay_namespaces` must run as root of a network namespace of its own (`unshare --net`).
Anything that is not as it should be raises.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.udp_mesh.daemon.processes import KEY, RATES, RunningDaemon, collect, outcomes, poll, wait_online
from tests.udp_mesh.daemon.veth_links import connect, isolated_daemon, join
from udp_mesh.cli.views import status_view

LINKS = (("alice", "r1", "10.1.0"), ("r1", "bob", "10.2.0"), ("alice", "r2", "10.3.0"), ("r2", "bob", "10.4.0"))
TOPICS = """
status = { priority = 0 }
map = { priority = 7 }
"""


def _daemon(folder: Path, name: str) -> RunningDaemon:
    relay = 'relay = ["bob"]' if name.startswith("r") else ""
    return isolated_daemon(folder, name, TOPICS, top=relay, more=RATES)


def _via(daemon: RunningDaemon, name: str) -> list[str]:
    with daemon.client() as client:
        routes = client.request("status")["relaying"]["routes"]
    return next((route["via"] for route in routes if route["name"] == name and route["in_use"]), [])


@contextlib.contextmanager
def _explained(daemons: Iterable[RunningDaemon]) -> Iterator[None]:
    """Adds what each daemon that still runs knows, and what every one logged, to an error."""
    try:
        yield
    except Exception as error:
        for daemon in daemons:
            assert daemon.process is not None
            if daemon.process.poll() is None:
                with daemon.client() as client:
                    error.add_note(f"{daemon.name}: {json.dumps(client.request('status'))}")
            error.add_note(f"log of {daemon.name}: {daemon.log.read_text()}")
        raise


def main() -> None:
    """They meet through a relay, exchange messages, and go on through the other one when the first is killed."""
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, contextlib.ExitStack() as stack:
        folder = Path(path)
        (folder / "key").write_text(KEY + "\n")
        daemons = {name: stack.enter_context(_daemon(folder, name)) for name in ("alice", "bob", "r1", "r2")}
        for left, right, network in LINKS:
            join(daemons, left, right, network)
            connect(daemons, left, right)
        stack.enter_context(_explained(daemons.values()))
        alice, bob = daemons["alice"], daemons["bob"]
        wait_online(alice, "bob")
        wait_online(bob, "alice")
        (relay,) = poll(lambda: _via(alice, "bob"), "a route to bob")
        with alice.client() as sender, bob.client() as receiver:
            receiver.subscribe("*")
            for size in (5, 200_000):
                sender.publish("map", bytes(size), to="bob", notify=True)
                (message,) = collect(receiver, 1)
                assert (message.source, len(message.payload)) == ("alice", size)
            assert set(outcomes(sender, 2).values()) == {"delivered"}
            process = daemons[relay].process
            assert process is not None
            process.kill()
            sender.publish("map", bytes(100_000), to="bob", notify=True)
            (message,) = collect(receiver, 1)
            assert len(message.payload) == 100_000
            assert set(outcomes(sender, 1).values()) == {"delivered"}
            assert _via(alice, "bob") == [{"r1": "r2", "r2": "r1"}[relay]]
            status = sender.request("status")
            page = status_view(status)
            assert "in use" in page


if __name__ == "__main__":
    main()
