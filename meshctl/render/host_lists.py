"""The fleet's hosts for other tools: an OpenSSH client configuration and an Ansible inventory. Pure.

Both name nodes as the inventory does and pin the same host keys: `HostKeyAlias` is the name that `meshctl trust` writes
into known_hosts (`robot.NAME` for a robot's computer).
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from meshctl.model import Computer, Fleet, Node, Release, Robot, Site, SshSettings

# OpenSSH's options for dropbear 2019.78, which signs and accepts RSA with SHA-1 only
_SHA1_RSA = ("HostKeyAlgorithms", "PubkeyAcceptedAlgorithms")


@dataclass(frozen=True, slots=True)
class HostEntry:
    """One SSH server: `alias` names its host key, `groups` are Ansible's, `is_openwrt` tells radios from computers."""

    name: str
    alias: str
    address: str
    ssh: SshSettings
    groups: tuple[str, ...]
    is_openwrt: bool
    has_sha1_rsa_only: bool = False


def lab_host_entries(
    fleet: Fleet, nodes: Iterable[Node], locate: Callable[[Node], tuple[str, int]]
) -> tuple[HostEntry, ...]:
    """The nodes of a virtual fleet at its forwarded ports, without jump hosts.

    Only computers with an `ssh.host` of their own: a lab has none, and the inventory's addresses may be real robots'.
    """

    def placed(node: Node) -> Node:
        host, port = locate(node)
        return replace(node, ssh=replace(node.ssh, host=host, port=port))

    test_machines = {name for name, _, computer in _computers(fleet) if computer.ssh.host}
    entries = host_entries(fleet, (placed(node) for node in nodes))
    return tuple(
        replace(entry, ssh=replace(entry.ssh, jump=""))
        for entry in entries
        if entry.is_openwrt or entry.name in test_machines
    )


def host_entries(fleet: Fleet, nodes: Iterable[Node]) -> tuple[HostEntry, ...]:
    """The nodes, the computers of all robots, and the gateways of sites, through which the site's nodes are reached."""
    listed = tuple(nodes)
    radios = [
        HostEntry(
            node.name,
            node.name,
            node.ssh.host or str(node.address.ip),
            _through(node.ssh, fleet.gateway_site(node)),
            tuple(dict.fromkeys((f"role_{node.role.value}", f"state_{node.state.value}", *node.groups))),
            is_openwrt=True,
            has_sha1_rsa_only=node.release is Release.V19_07,
        )
        for node in listed
    ]
    computers = [
        HostEntry(
            name,
            name,
            computer.ssh.host or str(computer.address.ip),
            _through(computer.ssh, fleet.robot_site(robot)),
            ("robots",),
            is_openwrt=False,
        )
        for name, robot, computer in _computers(fleet)
    ]
    gateways = [
        HostEntry(_gateway(site), _gateway(site), site.ssh.host, site.ssh, ("gateways",), is_openwrt=False)
        for site in fleet.sites.values()
        if site.has_gateway
    ]
    return (*radios, *computers, *gateways)


def _computers(fleet: Fleet) -> Iterator[tuple[str, Robot, Computer]]:
    """All computers of all robots, with the names of their host keys."""
    for name, robot in fleet.robots.items():
        for place, _, computer in robot.all_computers():
            yield ".".join(("robot", name, *place[1:])), robot, computer


def _gateway(site: Site) -> str:
    """The name of a site's gateway, also for its host key."""
    return f"site.{site.name}"


def _through(ssh: SshSettings, site: Site | None) -> SshSettings:
    """The login with the site's gateway as jump host, unless it has another."""
    return ssh if site is None or ssh.jump else replace(ssh, jump=_gateway(site))


def ssh_config(entries: Iterable[HostEntry], known_hosts: Path, key_path: Callable[[str], Path]) -> str:
    """Host blocks for `ssh -F FILE NAME` or an `Include` in ~/.ssh/config; see ssh_config(5)."""
    return "\n".join(line for entry in entries for line in (*_block(entry, known_hosts, key_path), ""))


def _block(entry: HostEntry, known_hosts: Path, key_path: Callable[[str], Path]) -> Iterator[str]:
    yield f"Host {entry.name}"
    yield f"    HostName {_literal(entry.address)}"
    if entry.ssh.port != 22:
        yield f"    Port {entry.ssh.port}"
    if entry.ssh.user:
        yield f"    User {entry.ssh.user}"
    yield f"    HostKeyAlias {entry.alias}"
    yield f"    UserKnownHostsFile {_quoted(known_hosts)}"
    yield from (f"    IdentityFile {_quoted(key_path(text))}" for text in entry.ssh.key_files)
    if entry.ssh.jump:
        yield f"    ProxyJump {entry.ssh.jump}"
    if entry.has_sha1_rsa_only:
        yield from (f"    {name} +ssh-rsa" for name in _SHA1_RSA)


def ansible_inventory(entries: Iterable[HostEntry], known_hosts: Path, key_path: Callable[[str], Path]) -> str:
    """A static YAML inventory (JSON is YAML). OpenWrt has no Python: the module `raw` works there, others do not."""
    groups: dict[str, dict[str, dict[str, object]]] = {}
    known = {entry.name: entry for entry in entries}
    for entry in known.values():
        options = [f"HostKeyAlias={entry.alias}", f"UserKnownHostsFile={_quoted(known_hosts)}"]
        # one private key has a variable of its own
        options += [f"IdentityFile={_quoted(key_path(text))}" for text in entry.ssh.key_files[1:]]
        if (jump := known.get(entry.ssh.jump)) is not None:
            options.append(f"ProxyCommand={_proxy_command(jump, known, known_hosts, key_path)}")
        options += [f"{name}=+ssh-rsa" for name in _SHA1_RSA] if entry.has_sha1_rsa_only else []
        variables: dict[str, object] = {
            "ansible_host": entry.address,
            "ansible_port": entry.ssh.port,
            **({"ansible_user": entry.ssh.user} if entry.ssh.user else {}),
            **({"ansible_ssh_private_key_file": str(key_path(entry.ssh.key_files[0]))} if entry.ssh.key_files else {}),
            # Ansible splits them like a shell; the quotation marks inside are for ssh, which splits a path at blanks
            "ansible_ssh_common_args": " ".join(f"-o {shlex.quote(option)}" for option in options),
            # `raw` asks for a terminal, which a program on a router does not need and which ends its lines with CR
            **({"ansible_ssh_use_tty": False} if entry.is_openwrt else {}),
        }
        own = ("openwrt" if entry.is_openwrt else "computers", *entry.groups)
        for index, group in enumerate(dict.fromkeys(_group_name(name) for name in own)):
            # variables once: Ansible merges a host that several groups list
            groups.setdefault(group, {})[entry.name] = {} if index else variables
    children = {group: {"hosts": hosts} for group, hosts in groups.items()}
    return json.dumps({"all": {"children": children}}, indent=2) + "\n"


def _proxy_command(
    jump: HostEntry, known: Mapping[str, HostEntry], known_hosts: Path, key_path: Callable[[str], Path]
) -> str:
    """Connect through a jump host. ProxyJump would look its name up in DNS: here, no `Host` block says where it is."""
    options = [f"HostKeyAlias={jump.alias}", f"UserKnownHostsFile={_quoted(known_hosts)}"]
    options += [f"IdentityFile={_quoted(key_path(text))}" for text in jump.ssh.key_files]
    options += [f"{name}=+ssh-rsa" for name in _SHA1_RSA] if jump.has_sha1_rsa_only else []
    if (before := known.get(jump.ssh.jump)) is not None:
        options.append(f"ProxyCommand={_proxy_command(before, known, known_hosts, key_path)}")
    login = f"{jump.ssh.user}@{jump.address}" if jump.ssh.user else jump.address
    words = ["ssh", "-p", str(jump.ssh.port), *(word for option in options for word in ("-o", option))]
    # ssh expands %h and %p once for each level, and an IPv6 address needs the brackets
    own = shlex.join(words).replace("%", "%%")
    return f"{own} -W '[%h]:%p' {shlex.quote(_literal(login))}"


def _group_name(name: str) -> str:
    """Ansible's group names are identifiers."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)


def _literal(text: str) -> str:
    """ssh_config expands %-tokens in HostName, which the zone of fe80::1%eth0 must not be."""
    return text.replace("%", "%%")


def _quoted(path: Path) -> str:
    return f'"{path}"' if " " in str(path) else str(path)
