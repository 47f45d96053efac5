"""The guides on shared logs, relays and differences: their configurations run on real daemons, and their commands work.

Only links are added: on loopback each daemon lists its neighbors, and the base and the far robot know only the Husky.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.processes import KEY, RATES, RunningDaemon, collect, poll, wait_online
from tests.udp_mesh.links.sockets import WAIT_S, free_port

GUIDES = Path(__file__).parents[3] / "docs" / "how-to"
# By node: its addresses, 127.0.3.*, each a link, and the neighbor there. The Husky has two links.
LINKS: Mapping[str, Mapping[int, int]] = {"base": {1: 2}, "husky1": {2: 1, 12: 3}, "far": {3: 12}}

pytestmark = pytest.mark.xdist_group("udp_mesh_daemons")


class Guide:
    """One page: its configuration, and its commands without `udp-mesh`."""

    def __init__(self, name: str) -> None:
        text = (GUIDES / f"{name}.md").read_text(encoding="utf-8")
        [self.configuration] = re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        self.commands: list[str] = re.findall(r"^\$ udp-mesh (.*)$", text, re.MULTILINE)

    def command(self, start: str) -> str:
        """The first command that begins so."""
        return next(command for command in self.commands if command.startswith(start))


@contextmanager
def team(guide: Guide, far: str) -> Iterator[dict[str, RunningDaemon]]:
    """The base, the Husky and the far robot of this name, with the guide's configuration; none runs yet."""
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, ExitStack() as stack:
        folder = Path(path)
        (folder / "fleet.key").write_text(KEY)
        daemons = {}
        for place, links in LINKS.items():
            name = far if place == "far" else place
            text = re.sub(r'^name = ".*"', f'name = "{name}"', guide.configuration, flags=re.MULTILINE)
            if name != "husky1":
                # Nothing is configured at the ends.
                text = re.sub(r"^relay = .*\n", "", text, flags=re.MULTILINE)
            for own, other in links.items():
                text += f'\n[[links]]\naddress = "127.0.3.{own}"\nkind = "neighbours"\n'
                text += f'[[neighbours]]\naddress = "127.0.3.{other}"\nlink = "127.0.3.{own}"\n'
            more = f'[daemon]\nsocket = "{folder / name}.sock"\nstate_directory = "{folder / name}"\n'
            daemons[name] = RunningDaemon(folder, name, f"port = {port}\n{text}{RATES}{more}")
            stack.callback(daemons[name].stop)
        yield daemons


def udp_mesh(daemon: RunningDaemon, command: str) -> str:
    """The output of a command line in the daemon's folder."""
    shell = f'exec {sys.executable} -m udp_mesh.cli.main {command} --socket "{daemon.socket}"'
    here = Path(__file__).parents[3]
    environment = {**os.environ, "PYTHONPATH": str(here)}
    done = subprocess.run(
        shell, shell=True, cwd=daemon.folder, env=environment, capture_output=True, text=True, timeout=WAIT_S
    )
    assert done.returncode == 0, (command, done.stdout, done.stderr)
    return done.stdout


def test_an_artifact_reaches_a_base_that_its_robot_never_meets() -> None:
    guide = Guide("collect-artifacts")
    with team(guide, "spot") as daemons:
        spot, husky, base = daemons["spot"], daemons["husky1"], daemons["base"]
        spot.start()
        udp_mesh(spot, guide.command("pub"))
        husky.start()
        poll(lambda: "husky1 1" in udp_mesh(spot, "logs"), "the Husky carries the artifact")
        spot.kill()
        base.start()
        with base.client() as program:
            program.request("subscribe", topics=[guide.command("echo").split()[-1]])
            [message] = collect(program, 1)
        assert (message.source, message.payload) == ("spot", b"backpack at 12.5 3.0 -1.2")
        row = re.compile(r"^artifacts +spot +1 of 1 .* -$", re.MULTILINE)
        poll(lambda: row.search(udp_mesh(base, guide.command("logs"))), "no reader lacks the artifact")


def test_a_robot_is_reached_through_the_relay() -> None:
    guide = Guide("relay-robots")
    with team(guide, "uav1") as daemons:
        for daemon in daemons.values():
            daemon.start()
        base, husky, uav = daemons["base"], daemons["husky1"], daemons["uav1"]
        wait_online(base, "uav1")
        row = re.compile(r"^uav1 +husky1 +2 +2\.\d +in use +husky1$", re.MULTILINE)
        poll(lambda: row.search(udp_mesh(base, guide.command("status"))), "the path through the Husky is in use")
        assert "uav1: " in udp_mesh(base, f"{guide.command('ping')} --count 1")
        (base.folder / "map.bin").write_bytes(os.urandom(50_000))
        with uav.client() as program:
            program.request("subscribe", topics=["map", "estop"])
            assert udp_mesh(base, guide.command("pub map")).startswith("delivered uav1 ")
            udp_mesh(base, guide.command("pub estop"))
            messages = collect(program, 2)
        assert sorted((message.topic, len(message.payload)) for message in messages) == [("estop", 4), ("map", 50_000)]
        passed_on = re.search(r"^relay: (\d+) datagrams forwarded", udp_mesh(husky, "status"), re.MULTILINE)
        assert passed_on is not None
        assert int(passed_on[1]) > 30


def test_the_second_map_is_sent_as_a_difference() -> None:
    guide = Guide("send-differences")
    with team(guide, "uav1") as daemons:
        base, husky = daemons["base"], daemons["husky1"]
        base.start()
        husky.start()
        wait_online(husky, "base")
        first, second = [command for command in guide.commands if command.startswith("pub map")]
        versions = [os.urandom(200_000)]
        versions.append(versions[0][:50_000] + bytes(1000) + versions[0][51_000:])
        with base.client() as program:
            program.request("subscribe", topics=["map"])
            for command, version in zip((first, second), versions, strict=True):
                (husky.folder / "map.bin").write_bytes(version)
                assert udp_mesh(husky, command).startswith("delivered base ")
            assert [message.payload for message in collect(program, 2)] == versions
        row = re.search(r"^map +1 +1 +400 kB +200 kB +", udp_mesh(husky, guide.command("topics")), re.MULTILINE)
        assert row is not None
