"""The way to a robot's computer: its endpoint in the inventory -> SSH, through its radio if need be -> root -> `Host`.

Host keys are pinned in the fleet's own file under `robot.NAME`, since a node may have the robot's name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

from meshctl.apply.access import Access
from meshctl.apply.bootstrap import Recorder
from meshctl.device.connection import Credentials, Endpoint
from meshctl.device.errors import AuthenticationRefused
from meshctl.device.ssh import connect
from meshctl.device.trust import HostKey, HostKeyPolicy
from meshctl.errors import InputError
from meshctl.inventory.suggest import did_you_mean
from meshctl.model import Computer, Fleet, Secret
from meshctl.robots.host import Host, SshHost, become_root


def _no_password() -> Secret | None:
    return None


@dataclass(frozen=True, slots=True)
class Reach:
    """How to get at the computers of a fleet. `access` holds its pins, keys and the way through radios; `password` is
    what sudo gets where it wants one. Safe for many threads."""

    fleet: Fleet
    access: Access
    password: Callable[[], Secret | None] = field(default=_no_password, repr=False)

    def endpoint(self, robot: str) -> Endpoint:
        computer = self.computer(robot)
        host = computer.ssh.host or str(computer.address.ip)
        return Endpoint(host, computer.ssh.port, computer.ssh.user, identity=f"robot.{robot}")

    def computer(self, robot: str) -> Computer:
        """Raises InputError for a robot that has none."""
        computer = self.fleet.robots[robot].computer
        if computer is None:
            raise InputError(f"robot {robot} has no computer in the inventory", hint=f"write robots.{robot}.computer")
        return computer

    @contextmanager
    def host(self, robot: str, policy: HostKeyPolicy | None = None) -> Iterator[Host]:
        """The robot's computer, as root. Raises what `ssh.connect` and `become_root` raise."""
        settings = self.computer(robot).ssh
        named = tuple(self._path(text) for text in settings.key_files)
        jump = self.fleet.nodes.get(settings.jump) if settings.jump else None
        if settings.jump and jump is None:
            raise InputError(f"robots.{robot}.computer.ssh.jump: there is no node {settings.jump!r}")
        via = self.access.open(jump) if jump is not None else None
        try:
            with connect(
                self.endpoint(robot),
                credentials=Credentials((*self.access.key_files, *named), use_agent=self.access.use_agent),
                trust=policy or self.access.trust,
                deadlines=self.access.deadlines,
                via=via,
            ) as connection:
                yield SshHost(become_root(connection, self.password))
        finally:
            if via is not None:
                via.close()

    def shown_key(self, robot: str) -> HostKey | None:
        """The host key that the computer shows, believed by nobody. Raises what `ssh.connect` raises."""
        recorder = Recorder()
        settings = self.computer(robot).ssh
        jump = self.fleet.nodes.get(settings.jump)
        via = self.access.open(jump) if jump is not None else None
        try:
            # without credentials: the key is shown before anyone logs in
            connect(
                self.endpoint(robot),
                credentials=Credentials(use_agent=False),
                trust=recorder,
                deadlines=self.access.deadlines,
                via=via,
            ).close()
        except AuthenticationRefused:
            # expected: what was asked for has come before
            return recorder.key
        finally:
            if via is not None:
                via.close()
        return recorder.key

    def _path(self, text: str) -> Path:
        path = Path(text).expanduser()
        return path if path.is_absolute() else Path(self.fleet.base) / path


def chosen_robots(fleet: Fleet, patterns: Iterable[str] | None) -> tuple[str, ...]:
    """The robots with a computer that a name or pattern selects, in the inventory's order; all when none is given.

    Raises InputError for a pattern that selects nothing, and for a robot named that has no computer.
    """
    wanted = list(patterns or ())
    able = [name for name, robot in fleet.robots.items() if robot.computer is not None]
    if not able:
        raise InputError(f"no robot of {fleet.name} has a computer", hint="write robots.NAME.computer")
    for pattern in wanted:
        if not any(fnmatchcase(name, pattern) for name in able):
            if pattern in fleet.robots:
                raise InputError(f"robot {pattern} has no computer in the inventory")
            raise InputError(f"no robot of {fleet.name} is called {pattern!r}", hint=did_you_mean(pattern, able))
    return tuple(name for name in able if not wanted or any(fnmatchcase(name, pattern) for pattern in wanted))
