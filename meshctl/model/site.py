"""SSH logins, and sites with the workers that provision their nodes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SshSettings:
    """SSH access to a device: an empty `host` means its own address; `jump` is a node used as jump host."""

    host: str = ""
    port: int = 22
    user: str = "root"
    key_files: tuple[str, ...] = ()
    jump: str = ""


OWN_ADDRESS = SshSettings()


@dataclass(frozen=True, slots=True)
class NatsHub:
    """The NATS server that stores orders for sites. `credentials` and `ca` are files of the operator, `domain` is the
    server's JetStream domain. An order for a site that is offline is good for `order_hours`."""

    url: str
    credentials: str = ""
    ca: str = ""
    domain: str = "hub"
    order_hours: int = 24


@dataclass(frozen=True, slots=True)
class SiteNats:
    """The NATS leaf node of a site: `url` as its worker there uses it, and its JetStream `domain`."""

    domain: str
    url: str = "nats://127.0.0.1:4222"


@dataclass(frozen=True, slots=True)
class Site:
    """A place with nodes of its own. `ssh` is the login to its gateway, where a worker provisions them; `nats` is how
    that worker is reached while it is there permanently. With neither there is no worker. The nodes accept the SSH
    public key `worker_key`."""

    name: str
    ssh: SshSettings = OWN_ADDRESS
    worker_key: str = ""
    nats: SiteNats | None = None

    @property
    def has_gateway(self) -> bool:
        """Whether the operator can log in to the computer with the worker."""
        return bool(self.ssh.host)

    @property
    def has_worker(self) -> bool:
        return self.has_gateway or self.nats is not None
