"""SSH connections to the nodes of a fleet: endpoints, credentials, and a pool.

`ConnectionPool.open` makes a new connection, which proves a changed node reachable; `ConnectionPool.borrow` reuses one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Protocol

from meshctl.device.authentication import own_keys
from meshctl.device.connection import Credentials, Deadlines, Endpoint, OwnKey
from meshctl.device.errors import AuthenticationRefused, ConnectionLost, Timeout
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.traffic import TrafficMeter
from meshctl.device.trust import HostKeyPolicy, TrustStore
from meshctl.errors import InputError, NodeError, Unreachable
from meshctl.inventory.file_paths import file_path
from meshctl.model import Fleet, Node, Site
from meshctl.model.ip import IpAddress
from meshctl.nodes.site_gateways import PIN_PREFIX, connect_gateway, gateway_credentials
from meshctl.nodes.slots import ChannelSlots

# Closing waits up to two seconds for a connection whose other side is gone, so a fleet's are closed in parallel.
MAX_PARALLEL_CLOSES = 32


class Locate(Protocol):
    """The host and port at which a node with this address is reached."""

    def __call__(self, node: Node, address: IpAddress) -> tuple[str, int]: ...


class SshAddress(NamedTuple):
    """Where a node accepts logins."""

    address: IpAddress
    port: int


def as_written(node: Node, address: IpAddress) -> tuple[str, int]:
    """The inventory's `ssh.host`, or the address itself."""
    return node.ssh.host or str(address), node.ssh.port


@dataclass(slots=True)
class ConnectionPool:
    """Opens connections to nodes and keeps them for reuse. Thread-safe; each connection belongs to one thread at a
    time.

    `key_files` come before those of the inventory. `trust` is the file of pinned host keys; `policy`, if set, judges
    host keys instead and may ask about unknown ones.
    """

    fleet: Fleet
    trust: TrustStore
    key_files: tuple[Path, ...] = ()
    use_agent: bool = True
    deadlines: Deadlines = field(default_factory=Deadlines)
    policy: HostKeyPolicy | None = None
    locate: Locate = as_written
    # node -> endpoint of a device on the bench, which may accept a login without a password
    bench_endpoints: dict[str, Endpoint] = field(default_factory=dict)
    # node -> local interface it was discovered on, tried first for its new address
    interfaces: dict[str, str] = field(default_factory=dict)
    # node -> where it was last seen, if the inventory has another address or port by now
    former_places: Callable[[], Mapping[str, SshAddress]] = dict
    meter: TrafficMeter = field(default_factory=TrafficMeter, repr=False)
    # nodes whose device is on a cable of the operator's: not behind the gateway of their site
    on_bench: set[str] = field(default_factory=set)
    slots: ChannelSlots = field(default_factory=ChannelSlots, repr=False)
    _kept: dict[str, SshConnection] = field(default_factory=dict, repr=False)
    _own_keys: dict[Credentials, tuple[OwnKey, ...]] = field(default_factory=dict, repr=False)
    _jumps: dict[str, SshConnection] = field(default_factory=dict, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _jump_lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    # a jump node may itself be behind a gateway
    _gateway_lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def endpoint(self, node: Node, address: IpAddress | None = None) -> Endpoint:
        host, port = self.locate(node, address or node.address.ip)
        return Endpoint(host, port, node.ssh.user, identity=node.name, interface=self.interfaces.get(node.name, ""))

    def candidates(self, node: Node, address: IpAddress | None = None) -> tuple[Endpoint, ...]:
        """The endpoints to try for a node: through its local interface, if known, then by the routing table.

        A router also answers at its address in the robot's LAN; over a wire to its LAN port only there.
        """
        endpoints = [self.endpoint(node, address)]
        if address is None and node.lan_address is not None and not node.ssh.host:
            endpoints.append(self.endpoint(node, node.lan_address.ip))
        by_routing_table = [replace(candidate, interface="") for candidate in endpoints if candidate.interface]
        return (*endpoints, *by_routing_table)

    def credentials(self, node: Node, endpoint: Endpoint | None = None) -> Credentials:
        """The credentials for a node: keys, and no password only on the bench. At its own address only a login with a
        key proves that the operators are not locked out."""
        named = tuple(file_path(self.fleet, text) for text in node.ssh.key_files)
        is_new = endpoint is not None and endpoint == self.bench_endpoints.get(node.name)
        return Credentials(key_files=(*self.key_files, *named), use_agent=self.use_agent, empty_password=is_new)

    def own_keys(self, node: Node) -> tuple[OwnKey, ...]:
        """The keys that can log in to this node once it is provisioned. Raises InputError for an unusable key file."""
        credentials = self.credentials(node)
        with self._lock:
            if credentials not in self._own_keys:
                self._own_keys[credentials] = own_keys(credentials)
            return self._own_keys[credentials]

    def open(
        self,
        node: Node,
        *,
        endpoint: Endpoint | None = None,
        policy: HostKeyPolicy | None = None,
        credentials: Credentials | None = None,
        deadlines: Deadlines | None = None,
    ) -> SshConnection:
        """A new connection, owned by the caller. Raises what `ssh.connect` raises.

        Without `endpoint`, the node's candidates are tried, then its former address and port, where only its pinned key
        is accepted: another device may have that address.
        """

        def connect_to(where: Endpoint) -> SshConnection:
            via = self._via(node)
            began_s = time.monotonic()
            connection = connect(
                where,
                credentials=credentials or self.credentials(node, where),
                trust=policy or self.policy or self.trust,
                deadlines=deadlines or self.deadlines,
                via=via,
                release=node.release,
                meter=self.meter,
            )
            self.slots.login_ended(node.name, time.monotonic() - began_s)
            return connection

        places = (endpoint,) if endpoint is not None else self.candidates(node)
        silent_server: Timeout | None = None
        while True:
            where, *places_left = places
            try:
                return connect_to(where)
            except Unreachable as failure:
                if isinstance(failure, Timeout) and failure.is_server_silent:
                    silent_server = failure
                # a server that accepts says more than that it has no other address
                error = silent_server or failure
                places = tuple(places_left)
                if not places:
                    is_pinned_only = policy is None and self.policy is None
                    former = self._former_endpoint(node) if endpoint is None and is_pinned_only else None
                    if former is not None:
                        try:
                            return connect_to(former)
                        except (Unreachable, AuthenticationRefused) as elsewhere:
                            error.args = (f"{error}; where it was last seen, {elsewhere}",)
                        except NodeError:
                            pass  # another device has that address by now
                    error.hint = self._site_hint(node) or error.hint
                    raise error from failure.__cause__

    def _former_endpoint(self, node: Node) -> Endpoint | None:
        place = self.former_places().get(node.name)
        if place is None:
            return None
        endpoint = self.endpoint(node, place.address)
        # elsewhere the port is not the node's own
        if self.locate is as_written and not node.ssh.host:
            endpoint = replace(endpoint, port=place.port)
        return None if endpoint in self.candidates(node) else endpoint

    def _site_hint(self, node: Node) -> str:
        """The hint for a node that cannot be reached from here because its site has no login."""
        site = self.fleet.worker_site(node)
        if site is None or site.has_gateway or node.ssh.jump or node.ssh.host or node.name in self.on_bench:
            return ""
        return (
            f"site {site.name} is reached over NATS only, where status, plan, provision, apply and rollback work: "
            f"set sites.{site.name}.ssh.host for the rest, or use a computer in the network of the site"
        )

    def _via(self, node: Node) -> SshConnection | None:
        if not node.ssh.jump:
            site = self.fleet.gateway_site(node)
            return self.gateway(site) if site is not None and node.name not in self.on_bench else None
        through = self.fleet.nodes.get(node.ssh.jump)
        if through is None:
            raise InputError(f"node {node.name}: ssh.jump names {node.ssh.jump!r}, which is not in the fleet")
        with self._jump_lock:
            kept = self._jumps.get(through.name)
            if kept is None or not kept.is_open:
                # only one hop: the jump node's own ssh.jump is ignored
                kept = self._jumps[through.name] = self.open(replace(through, ssh=replace(through.ssh, jump="")))
            return kept

    def gateway(self, site: Site) -> SshConnection:
        """The connection to a site's gateway, through which its nodes are reached; the pool owns it."""
        with self._gateway_lock:
            name = f"{PIN_PREFIX}{site.name}"
            kept = self._jumps.get(name)
            if kept is None or not kept.is_open:
                kept = self._jumps[name] = self.connect_gateway(site)
            return kept

    def connect_gateway(self, site: Site, policy: HostKeyPolicy | None = None) -> SshConnection:
        """A new connection to a site's gateway, owned by the caller. Raises what `ssh.connect` raises."""
        credentials = gateway_credentials(self.fleet, site, self.key_files, use_agent=self.use_agent)
        return connect_gateway(site, credentials, policy or self.trust, self.deadlines, self.meter)

    @contextmanager
    def borrow(self, node: Node) -> Iterator[SshConnection]:
        """A pooled connection to a node, or a new one; it returns to the pool unless it broke."""
        connection = self.acquire(node.name) or self.open(node)
        try:
            yield connection
        except ConnectionLost:
            connection.close()
            raise
        except BaseException:
            self.release(node.name, connection)
            raise
        self.release(node.name, connection)

    def acquire(self, name: str) -> SshConnection | None:
        """Take the pooled connection if it is still open; the caller owns it."""
        with self._lock:
            kept = self._kept.pop(name, None)
        if kept is not None and not kept.is_open:
            kept.close()
            return None
        return kept

    def release(self, name: str, connection: SshConnection) -> None:
        """Return a connection to the pool."""
        if not connection.is_open:
            connection.close()
            return
        with self._lock:
            old = self._kept.get(name)
            self._kept[name] = connection
        if old is not None and old is not connection:
            old.close()

    def drop(self, name: str) -> None:
        """Close the pooled connection to a node."""
        kept = self.acquire(name)
        if kept is not None:
            kept.close()

    def close(self) -> None:
        """Close all connections in parallel, those through a jump node before the jump itself."""
        with self._lock:
            kept, jumps = list(self._kept.values()), list(self._jumps.values())
            self._kept.clear()
            self._jumps.clear()
        _close(kept)
        _close(jumps)

    def __enter__(self) -> ConnectionPool:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _close(connections: Iterable[SshConnection]) -> None:
    with ThreadPoolExecutor(MAX_PARALLEL_CLOSES, "close") as pool:
        for _ in pool.map(lambda connection: connection.close(), connections):
            pass
