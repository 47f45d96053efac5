"""The way to a robot's computer: its endpoint in the inventory -> SSH, through its radio if need be -> root -> `Host`.

Host keys are pinned in the fleet's own file under `robot.NAME`, since a node may have the robot's name.
"""

from __future__ import annotations

import getpass
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

from meshctl.device.connection import Connection, Credentials, Endpoint
from meshctl.device.errors import AuthenticationRefused, HostKeyChanged, HostKeyUnknown
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import AcceptAnyKey, HostKey, HostKeyPolicy
from meshctl.errors import InputError, NodeError, Unreachable
from meshctl.inventory.suggest import did_you_mean
from meshctl.model import Fleet, Secret
from meshctl.nodes.connections import ConnectionPool
from meshctl.robots.host import Host, SshHost, become_root
from meshctl.robots.preconditions import computer_of


def _no_password() -> Secret | None:
    return None


@dataclass(frozen=True, slots=True)
class RobotConnector:
    """How to get at the computers of a fleet. `access` holds its pins, keys and the way through radios; `password` is
    what sudo gets where it wants one; `owner` names us to the robots' locks. Safe for many threads."""

    fleet: Fleet
    access: ConnectionPool
    password: Callable[[], Secret | None] = field(default=_no_password, repr=False)
    owner: str = ""

    def endpoint(self, robot: str) -> Endpoint:
        computer = computer_of(self.fleet, robot)
        host = computer.ssh.host or str(computer.address.ip)
        user = computer.ssh.user or local_user(robot)
        return Endpoint(host, computer.ssh.port, user, identity=f"robot.{robot}")

    @contextmanager
    def host(
        self, robot: str, policy: HostKeyPolicy | None = None, *, opened: Callable[[Connection], None] = lambda _: None
    ) -> Iterator[Host]:
        """The robot's computer, as root. Raises what `ssh.connect` and `become_root` raise.

        `opened` gets the connection as soon as it stands, for somebody else to close when all shall end at once.
        """
        settings = computer_of(self.fleet, robot).ssh
        named = tuple(self._path(text) for text in settings.key_files)
        with self._connected(
            robot,
            Credentials((*self.access.key_files, *named), use_agent=self.access.use_agent),
            policy or self.access.trust,
        ) as connection:
            opened(connection)
            yield SshHost(become_root(connection, self.password), self.owner)

    @contextmanager
    def _connected(self, robot: str, credentials: Credentials, trust: HostKeyPolicy) -> Iterator[SshConnection]:
        endpoint = self.endpoint(robot)
        with ExitStack() as stack:
            via = self._jump(robot)
            if via is not None:
                stack.callback(via.close)
            try:
                connection = connect(
                    endpoint, credentials=credentials, trust=trust, deadlines=self.access.deadlines, via=via
                )
            except NodeError as error:
                is_user_written = bool(computer_of(self.fleet, robot).ssh.user)
                error.hint = _hint_for(error, robot, endpoint, is_user_written=is_user_written) or error.hint
                raise
            yield stack.enter_context(connection)

    def _jump(self, robot: str) -> SshConnection | None:
        """The radio on the way, logged in; None where there is none."""
        name = computer_of(self.fleet, robot).ssh.jump
        if not name:
            return None
        radio = self.fleet.nodes.get(name)
        if radio is None:
            place = f"robots.{robot}.computer.ssh.jump"
            raise InputError(f"{place}: there is no node {name!r}", hint=did_you_mean(name, self.fleet.nodes))
        return self.access.open(radio)

    def presented_key(self, robot: str) -> HostKey | None:
        """The host key that the computer shows, believed by nobody. Raises what `ssh.connect` raises."""
        recorder = AcceptAnyKey()
        try:
            # without credentials: the key is shown before anyone logs in
            with self._connected(robot, Credentials(use_agent=False), recorder):
                return recorder.key
        except AuthenticationRefused:
            # expected of the computer, which has shown its key before; the radio on the way must let us in
            if recorder.key is None:
                raise
            return recorder.key

    def _path(self, text: str) -> Path:
        path = Path(text).expanduser()
        return path if path.is_absolute() else Path(self.fleet.base) / path


def local_user(robot: str) -> str:
    """Who logs in where the inventory names nobody: the operator, as OpenSSH has it. Raises InputError for a process
    without a name, as in a container."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        place = f"robots.{robot}.computer.ssh.user"
        raise InputError(
            f"{place}: names nobody, and whoever runs this has no name either", hint=f"write {place}"
        ) from None


def _hint_for(error: NodeError, robot: str, endpoint: Endpoint, *, is_user_written: bool) -> str:
    """What helps with a computer, where the device layer knows radios; empty for what is the same."""
    place = f"robots.{robot}.computer.ssh"
    match error:
        case AuthenticationRefused():
            keys = f"put your public key into ~{endpoint.user}/.ssh/authorized_keys there (ssh-copy-id)"
            if is_user_written:
                return f"{keys}, or name another in {place}"
            return f"the inventory names no user, so {endpoint.user} was tried, your own: write {place}.user, or {keys}"
        case HostKeyUnknown():
            return f"compare it with the computer's own, then run `meshctl robots trust {robot}`"
        case HostKeyChanged():
            again = f"`meshctl robots trust --replace {robot}` once you know"
            return f"another computer, a new installation, or an attack; {again}"
        case Unreachable() if isinstance(error.__cause__, socket.gaierror):
            return f"no address is known here for {endpoint.host}: write one into {place}.host, or take that away"
        case Unreachable():
            return f"is it on, does sshd run there, and is robots.{robot}.computer right?"
        case _:
            return ""


def selected_robots(fleet: Fleet, patterns: Iterable[str] | None) -> tuple[str, ...]:
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
                fielded = fleet.robots[pattern].fielded is not None
                instead = " in place of `fielded`, and stop the fielded program there" if fielded else ""
                hint = f"write robots.{pattern}.computer{instead}"
                raise InputError(f"robot {pattern} has no computer in the inventory", hint=hint)
            raise InputError(f"no robot of {fleet.name} is called {pattern!r}", hint=did_you_mean(pattern, able))
    return tuple(name for name in able if not wanted or any(fnmatchcase(name, pattern) for pattern in wanted))
