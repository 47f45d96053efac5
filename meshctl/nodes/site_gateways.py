"""The gateway of a site: the computer with its worker, and the jump host to its nodes.

Its host key is pinned in the fleet's known_hosts as `site.NAME`.
"""

from __future__ import annotations

import getpass
from pathlib import Path

from meshctl.device.connection import Credentials, Deadlines, Endpoint
from meshctl.device.errors import AuthenticationRefused, HostKeyChanged, HostKeyUnknown
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.traffic import TrafficMeter
from meshctl.device.trust import HostKeyPolicy
from meshctl.errors import InputError, NodeError, Unreachable
from meshctl.inventory.file_paths import file_path
from meshctl.model import Fleet, Site

PIN_PREFIX = "site."


def local_user(place: str) -> str:
    """The default login name: the local user, as in OpenSSH. `place` is where the inventory may set another.

    Raises InputError if the local user has no name, as in a container."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        raise InputError(f"{place} is not set, and the current user has no name", hint=f"set {place}") from None


def gateway_endpoint(site: Site) -> Endpoint:
    """Raises InputError for a site without a gateway."""
    if not site.has_gateway:
        raise InputError(f"site {site.name} has no gateway", hint=f"set sites.{site.name}.ssh.host")
    user = site.ssh.user or local_user(f"sites.{site.name}.ssh.user")
    return Endpoint(site.ssh.host, site.ssh.port, user, identity=f"{PIN_PREFIX}{site.name}")


def gateway_credentials(fleet: Fleet, site: Site, key_files: tuple[Path, ...], *, use_agent: bool) -> Credentials:
    """`key_files` come before those of the site."""
    named = tuple(file_path(fleet, text) for text in site.ssh.key_files)
    return Credentials((*key_files, *named), use_agent=use_agent)


def connect_gateway(
    site: Site, credentials: Credentials, trust: HostKeyPolicy, deadlines: Deadlines, meter: TrafficMeter
) -> SshConnection:
    """A connection to the gateway. Raises what `ssh.connect` raises, with hints for a gateway."""
    endpoint = gateway_endpoint(site)
    try:
        return connect(endpoint, credentials=credentials, trust=trust, deadlines=deadlines, meter=meter)
    except NodeError as error:
        error.hint = _hint_for(error, site) or error.hint
        error.gateway_of = site.name
        raise


def _hint_for(error: NodeError, site: Site) -> str:
    match error:
        case AuthenticationRefused():
            return f"add your public key to ~/.ssh/authorized_keys there, or correct sites.{site.name}.ssh"
        case HostKeyUnknown():
            return f"compare the fingerprint on the gateway, then run `meshctl sites trust {site.name}`"
        case HostKeyChanged():
            again = f"verify, then run `meshctl sites trust --replace {site.name}`"
            return f"another computer, a new installation, or an attack: {again}"
        case Unreachable():
            return f"check the uplink of {site.name}, and sites.{site.name}.ssh"
        case _:
            return ""
