"""The sites of a fleet that runs in a lab.

The lab's inventory is a copy of the real one, with the real gateways' addresses: a plan sent there would change the
real nodes. So only gateways on this machine, as tests have them, are used; the nodes of other sites are reached
directly.
"""

from __future__ import annotations

from dataclasses import replace
from ipaddress import ip_address
from types import MappingProxyType
from urllib.parse import urlsplit

from meshctl.model import Fleet
from meshctl.model.site import Site


def without_real_gateways(fleet: Fleet) -> Fleet:
    """The fleet, with sites whose gateway is another machine as mere labels."""
    hub_is_here = fleet.nats is not None and is_this_machine(urlsplit(fleet.nats.url).hostname or "")

    def in_lab(site: Site) -> Site:
        return replace(
            site,
            # without a host there is no login to a gateway, but the key files are those of the orders over NATS
            ssh=site.ssh if is_this_machine(site.ssh.host) else replace(site.ssh, host=""),
            nats=site.nats if hub_is_here else None,
        )

    return replace(fleet, sites=MappingProxyType({name: in_lab(site) for name, site in fleet.sites.items()}))


def is_this_machine(host: str) -> bool:
    """Whether it is a loopback address, or `localhost`."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
