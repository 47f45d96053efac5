"""Real daemons in network namespaces of their own: Husky meets Spot, then the base, each for five seconds.

`python -m tests.udp_mesh.daemon.log_namespaces` must run as root of a network namespace of its own (`unshare --net`).
Anything that is not as it should be raises.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import tempfile
import time
from pathlib import Path

from tests.udp_mesh.daemon.processes import KEY, RunningDaemon, collect

MEETING_S = 5.0
LINKS = (("spot", "husky", "10.1.0"), ("husky", "base", "10.2.0"))
PAYLOADS = [*(b"artifact %d" % number for number in range(8)), os.urandom(200_000)]


def _daemon(folder: Path, name: str) -> RunningDaemon:
    configuration = f"""
name = "{name}"
key_file = "{folder}/key"
[topics]
artifact = {{ priority = 4, log = {{ readers = ["base"] }} }}
[daemon]
socket = "{folder / name}.sock"
state_directory = "{folder / name}"
"""
    daemon = RunningDaemon(folder, name, configuration)
    daemon.prefix = ["unshare", "--net"]
    return daemon


def _ip(daemon: RunningDaemon, words: str) -> None:
    assert daemon.process is not None
    subprocess.run(["nsenter", "-t", str(daemon.process.pid), "-n", "ip", *words.split()], check=True)


def _join(daemons: dict[str, RunningDaemon], left: str, right: str, network: str) -> None:
    """A veth pair between two daemons, each end named after the other one, with one end down."""
    one, other = daemons[left].process, daemons[right].process
    assert one is not None
    assert other is not None
    words = f"link add {right} netns {one.pid} type veth peer name {left} netns {other.pid}"
    subprocess.run(["ip", *words.split()], check=True)
    for place, (name, interface) in enumerate(((left, right), (right, left)), 1):
        _ip(daemons[name], f"addr add {network}.{place}/24 brd + dev {interface}")
    _ip(daemons[left], f"link set {right} up")


def _meet(daemons: dict[str, RunningDaemon], left: str, right: str) -> None:
    """The link is up for five seconds: this time is what the test is about."""
    _ip(daemons[right], f"link set {left} up")
    time.sleep(MEETING_S)
    _ip(daemons[right], f"link set {left} down")


def main() -> None:
    """Every artifact arrives once, with the rates of the field."""
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, contextlib.ExitStack() as stack:
        folder = Path(path)
        (folder / "key").write_text(KEY + "\n")
        daemons = {name: stack.enter_context(_daemon(folder, name)) for name in ("spot", "husky", "base")}
        for left, right, network in LINKS:
            _join(daemons, left, right, network)
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
