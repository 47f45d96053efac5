"""The uplink to a site by what the inventory says of it: NATS, or else SSH to its gateway.

The client of NATS is imported for a site that has it: with asyncio it is a tenth of the start of every command.
"""

from __future__ import annotations

from meshctl.errors import Unreachable
from meshctl.model import Fleet, Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.sites.ssh_uplink import SshUplink
from meshctl.sites.uplink import SiteOffline, Uplink


def open_uplink(fleet: Fleet, site: Site, access: ConnectionPool, *, must_answer: bool = True) -> Uplink:
    """The uplink; without `must_answer` also to a permanent worker that is offline. Raises Unreachable, InputError."""
    if site.nats is None:
        return SshUplink(fleet, site, access)
    from meshctl.sites.nats_uplink import NatsUplink

    try:
        return NatsUplink(fleet, site, access, must_answer=must_answer)
    except Unreachable as error:
        if not site.has_gateway:
            raise
        offline = error
    try:
        return SshUplink(fleet, site, access)
    except Unreachable as error:
        raise SiteOffline(f"{offline}; over SSH: {error}", hint=offline.hint) from error


def waiting_orders(fleet: Fleet, site: Site, access: ConnectionPool) -> tuple[str, ...]:
    """The runs whose orders wait for the site at the hub; none if the hub cannot be asked. Raises InputError."""
    if site.nats is None:
        return ()
    from meshctl.sites.nats_uplink import NatsUplink

    try:
        with NatsUplink(fleet, site, access, must_answer=False) as uplink:
            return uplink.waiting()
    except Unreachable:
        return ()
