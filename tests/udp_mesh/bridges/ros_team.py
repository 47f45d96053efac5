"""Whole robots for tests: each with a network of its own, a roscore, a daemon, a bridge and a node; one lossy link
joins them."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.link.laboratory import INTERFACE, Laboratory, Link, laboratory
from tests.udp_mesh.bridges.ros1_processes import Master, Ros1Bridge, Ros1Node
from tests.udp_mesh.daemon.processes import KEY, PATIENT_RATES, RunningDaemon, poll, wait_online

LOSSY = Link(rate=20e6, delay_ms=5.0, loss=0.05)
"""Loss in both directions, acknowledgments included."""

TOPICS = """
[topics]
status = { priority = 0 }
odometry = { priority = 3, reliable = false, keep_last = 1 }
plan = { priority = 4 }
map = { priority = 5 }
image = { priority = 9, keep_last = 1 }
"""


class RobotsDaemon(RunningDaemon):
    """A daemon in a robot's own network, on the shared link, which finds its peers."""

    def __init__(
        self, folder: Path, name: str, inside: Sequence[str], topics: str = TOPICS, rates: str = PATIENT_RATES
    ) -> None:
        key = folder / f"{name}.key"
        key.write_text(KEY + "\n")
        self._inside = tuple(inside)
        super().__init__(
            folder,
            name,
            f'name = "{name}"\nkey_file = "{key}"\n[[links]]\ninterface = "{INTERFACE}"\n{topics}{rates}'
            f'[daemon]\nsocket = "{folder / name}.sock"\nstate_directory = "{folder / name}"\n',
        )

    def start(self) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*self._inside, sys.executable, "-m", "udp_mesh.cli.main", "run", str(self.file)],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self.environment},
            )
        poll(self._answers, f"{self.name} answers")


@dataclass
class Member:
    """One robot of the team; `node` is a program of its autonomy."""

    name: str
    daemon: RobotsDaemon
    master: Master
    bridge: Ros1Bridge
    node: Ros1Node


@contextmanager
def masters_on_one_link(names: Sequence[str], link: Link) -> Iterator[tuple[Laboratory, dict[str, Master]]]:
    """A computer with a roscore of its own for each name. The masters are started; they may not answer yet."""
    # A Unix socket's path has at most 107 bytes: pytest's folders are too long.
    with (
        tempfile.TemporaryDirectory(prefix="udp-mesh-") as path,
        laboratory(len(names), link=link) as lab,
        ExitStack() as kept,
    ):
        masters = {name: Master(Path(path), name, lab.inside(place, [])) for place, name in enumerate(names)}
        for master in masters.values():
            kept.callback(master.stop)
            master.start(wait=False)
        yield lab, masters


@contextmanager
def team(*names: str, link: Link = LOSSY, topics: str = TOPICS) -> Iterator[tuple[Laboratory, list[Member]]]:
    """Robots of these names on one link, all of them online for one another."""
    with masters_on_one_link(names, link) as (lab, masters), ExitStack() as kept:
        members = []
        for name, master in masters.items():
            daemon = RobotsDaemon(master.folder, name, master.inside, topics)
            kept.enter_context(daemon)
            master.wait()
            bridge = Ros1Bridge(master, daemon)
            kept.callback(bridge.stop)
            bridge.start()
            node = Ros1Node(master, f"{name}_node")
            kept.callback(node.close)
            members.append(Member(name, daemon, master, bridge, node))
        for member in members:
            for other in names:
                if other != member.name:
                    wait_online(member.daemon, other)
        yield lab, members
