"""Real daemons in network namespaces of their own: Husky meets Spot, then the base, each for five seconds.

`python -m tests.udp_mesh.daemon.log_namespaces` must run as root of a network namespace of its own (`unshare --net`).
Anything that is not as it should be raises.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from pathlib import Path

from tests.udp_mesh.daemon.processes import KEY, RunningDaemon, collect
from tests.udp_mesh.daemon.veth_links import connect, isolated_daemon, join

MEETING_S = 5.0
TOPICS = 'artifact = { priority = 4, log = { readers = ["base"] } }'
LINKS = (("spot", "husky", "10.1.0"), ("husky", "base", "10.2.0"))
PAYLOADS = [*(b"artifact %d" % number for number in range(8)), os.urandom(200_000)]


def _meet(daemons: dict[str, RunningDaemon], left: str, right: str) -> None:
    """The link is up for five seconds: this time is what the test is about."""
    connect(daemons, left, right)
    time.sleep(MEETING_S)
    connect(daemons, left, right, up=False)


def main() -> None:
    """Every artifact arrives once, with the rates of the field."""
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, contextlib.ExitStack() as stack:
        folder = Path(path)
        (folder / "key").write_text(KEY + "\n")
        daemons = {
            name: stack.enter_context(isolated_daemon(folder, name, TOPICS)) for name in ("spot", "husky", "base")
        }
        for left, right, network in LINKS:
            join(daemons, left, right, network)
        with daemons["spot"].client() as spot, daemons["base"].client() as base:
            base.subscribe("artifact")
            for payload in PAYLOADS:
                spot.publish("artifact", payload)
            _meet(daemons, "spot", "husky")
            assert list(base.messages(0.1)) == []
            _meet(daemons, "husky", "base")
            messages = collect(base, len(PAYLOADS))
            assert sorted(message.payload for message in messages) == sorted(PAYLOADS)
            assert {message.source for message in messages} == {"spot"}
            _meet(daemons, "spot", "husky")
            _meet(daemons, "husky", "base")
            assert list(base.messages(0.1)) == [], "nothing arrives twice"
            peers = {peer["name"] for peer in base.request("peers")["peers"]}
            assert peers == {"husky"}, "the base never met spot"


if __name__ == "__main__":
    main()
