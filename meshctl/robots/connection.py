"""Connect to a robot's computer: endpoint in the inventory -> SSH, with an optional jump host -> root -> `Host`.

Host keys are pinned in the fleet's known_hosts as `robot.NAME`, since a node may have the same name as the robot.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

from meshctl.device.connection import Connection, Credentials, Endpoint
from meshctl.device.errors import AuthenticationRefused, HostKeyChanged, HostKeyUnknown
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import AcceptAnyKey, HostKey, HostKeyPolicy
from meshctl.errors import InputError, NodeError, Unreachable
from meshctl.inventory.file_paths import file_path
from meshctl.inventory.selection import robot_attributes, select
from meshctl.model import Fleet, Secret
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.site_gateways import local_user
from meshctl.robots.host import Host, SshHost, become_root
from meshctl.robots.preconditions import computer_of
from meshctl.suggest import did_you_mean


def _no_password() -> Secret | None:
    return None


@dataclass(frozen=True, slots=True)
class RobotConnector:
    """Connects to the computers of a fleet. `access` holds pins, keys and connections to jump hosts; `password` returns
    the sudo password; `owner` is our name in the robots' locks; `lab` is the directory of a virtual fleet, which has no
    robots' computers. Thread-safe."""

    fleet: Fleet
    access: ConnectionPool
    password: Callable[[], Secret | None] = field(default=_no_password, repr=False)
    owner: str = ""
    lab: str = ""

    def endpoint(self, robot: str) -> Endpoint:
        computer = computer_of(self.fleet, robot)
        if self.lab and not computer.ssh.host:
            # while practicing, the inventory's address may be that of the real robot
            raise InputError(
                f"robot.{robot}: the lab in {self.lab} has no computers to log in to, and {computer.address.ip} may be "
                "the real robot's",
                hint=f"set robots.{robot}.computer.ssh.host to a test machine, or unset MESHCTL_LAB",
            )
        host = computer.ssh.host or str(computer.address.ip)
        user = computer.ssh.user or local_user(f"robots.{robot}.computer.ssh.user")
        return Endpoint(host, computer.ssh.port, user, identity=f"robot.{robot}")

    def require_a_computer(self, robots: Sequence[str]) -> None:
        """Raises InputError if the lab has no computer of any of these robots, so that a run could only fail."""
        if not self.lab or not robots or any(computer_of(self.fleet, robot).ssh.host for robot in robots):
            return
        raise InputError(
            f"the lab in {self.lab} has no computers to log in to, and the inventory's addresses of "
            f"{', '.join(robots)} may be those of the real robots",
            hint=f"set robots.{robots[0]}.computer.ssh.host to a test machine, or unset MESHCTL_LAB",
        )

    @contextmanager
    def host(
        self, robot: str, policy: HostKeyPolicy | None = None, *, opened: Callable[[Connection], None] = lambda _: None
    ) -> Iterator[Host]:
        """The robot's computer, as root. Raises what `ssh.connect` and `become_root` raise.

        `opened` gets the connection once it is established, so that it can be closed from another thread.
        """
        settings = computer_of(self.fleet, robot).ssh
        named = tuple(file_path(self.fleet, text) for text in settings.key_files)
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
            if via is None:
                via = self._gateway(robot)
            else:
                stack.callback(via.close)
            try:
                connection = connect(
                    endpoint,
                    credentials=credentials,
                    trust=trust,
                    deadlines=self.access.deadlines,
                    via=via,
                    meter=self.access.meter,
                )
            except NodeError as error:
                is_user_written = bool(computer_of(self.fleet, robot).ssh.user)
                error.hint = _hint_for(error, robot, endpoint, is_user_written=is_user_written) or error.hint
                raise
            yield stack.enter_context(connection)

    def _jump(self, robot: str) -> SshConnection | None:
        """The connection to the jump host; None without one."""
        name = computer_of(self.fleet, robot).ssh.jump
        if not name:
            return None
        radio = self.fleet.nodes.get(name)
        if radio is None:
            place = f"robots.{robot}.computer.ssh.jump"
            raise InputError(f"{place}: node {name!r} does not exist", hint=did_you_mean(name, self.fleet.nodes))
        return self.access.open(radio)

    def _gateway(self, robot: str) -> SshConnection | None:
        """The connection to the gateway of the site where the robot's radios are; None without one."""
        site = self.fleet.robot_site(self.fleet.robots[robot])
        return None if site is None else self.access.gateway(site)

    def presented_key(self, robot: str) -> HostKey | None:
        """The unverified host key that the computer presents. Raises what `ssh.connect` raises."""
        recorder = AcceptAnyKey()
        try:
            # without credentials: the key is presented before the login
            with self._connected(robot, Credentials(use_agent=False), recorder):
                return recorder.key
        except AuthenticationRefused:
            # expected from the computer, which has presented its key; a jump host must accept the login
            if recorder.key is None:
                raise
            return recorder.key


def _hint_for(error: NodeError, robot: str, endpoint: Endpoint, *, is_user_written: bool) -> str:
    """The hint for a computer in place of the one for a radio; empty to keep that."""
    place = f"robots.{robot}.computer.ssh"
    match error:
        case AuthenticationRefused():
            keys = f"add your public key to ~{endpoint.user}/.ssh/authorized_keys there (ssh-copy-id)"
            if is_user_written:
                return f"{keys}, or set another user in {place}"
            return f"the inventory has no user, so your own, {endpoint.user}, was tried: set {place}.user, or {keys}"
        case HostKeyUnknown():
            return f"compare the fingerprint on the computer, then run `meshctl robots trust {robot}`"
        case HostKeyChanged():
            again = f"verify, then run `meshctl robots trust --replace {robot}`"
            return f"another computer, a new installation, or an attack: {again}"
        case Unreachable() if isinstance(error.__cause__, socket.gaierror):
            return f"{endpoint.host} cannot be resolved: set an address in {place}.host, or remove it"
        case Unreachable():
            return f"check that it is on, that sshd runs, and robots.{robot}.computer"
        case _:
            return ""


def selected_robots(
    fleet: Fleet, words: Iterable[str] | None, read_file: Callable[[str], str], limits: Iterable[str] = ()
) -> tuple[str, ...]:
    """The robots with a computer that the words select (`inventory.selection`), in inventory order; all without words.

    Raises InputError for a word that selects nothing, and for a named robot without a computer.
    """
    wanted = list(words or ())
    able = [name for name, robot in fleet.robots.items() if robot.computer is not None]
    if not able:
        raise InputError(f"no robot of {fleet.name} has a computer", hint="set robots.NAME.computer")
    for name in wanted:
        if name in fleet.robots and name not in able:
            is_legacy = fleet.robots[name].fielded is not None
            instead = " in place of `fielded`, and stop the legacy program there" if is_legacy else ""
            raise InputError(
                f"robot {name} has no computer in the inventory", hint=f"set robots.{name}.computer{instead}"
            )
    candidates = {name: robot_attributes(fleet, fleet.robots[name]) for name in able}
    return select(wanted, candidates, read_file, limits, what=f"robot of {fleet.name}")
