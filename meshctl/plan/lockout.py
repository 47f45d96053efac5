"""Whether a plan would lock the operator out: authorized keys, the SSH server and its port, the firewall. Pure.

A change is confirmed over a login with a key. Without one of the operator's keys on the node, or an SSH server on the
port where meshctl logs in, it could never be confirmed and would roll back after its window, so it is refused
(`lockout`, `server_lockout`). A firewall may accept SSH in ways that are not checked here: `firewall_notes` only warns.
"""

from __future__ import annotations

import binascii
from base64 import b64decode
from collections.abc import Mapping, Sequence

from meshctl.device.connection import OwnKey, fingerprint_of
from meshctl.model import Node
from meshctl.plan.observed_files import management_section
from meshctl.plan.preconditions import FailedPrecondition
from meshctl.uci import Package, Section

# the values that libubox treats as false
_OFF = frozenset({"0", "off", "false", "no", "disabled"})
# the values of a rule's `proto` that include TCP
_TCP = frozenset({"tcp", "6", "tcpudp", "all", "any", "*", "0"})
AUTHORIZED_KEYS = "etc/dropbear/authorized_keys"
# dropbear's, where /etc/config/dropbear names none
SSH_PORT = 22


def lockout(node: Node, files: Mapping[str, bytes], own: Sequence[OwnKey]) -> FailedPrecondition | None:
    """The failed precondition of writing `files` (paths without a leading slash) if none of `own` could log in
    afterwards, or None."""
    content = files.get(AUTHORIZED_KEYS)
    # dropbear reads this file for root alone
    if content is None or node.ssh.user != "root":
        return None
    lines = [line for line in content.decode("utf-8", "replace").splitlines() if line.strip()]
    allowed = {word for line in lines for word in line.split()}
    # dropbear of 19.07 supports only RSA
    usable = [key for key in own if node.release.has_ed25519 or key.key_type == "ssh-rsa"]
    if any(key.base64 in allowed for key in usable):
        return None
    ours = ", ".join(f"{key.fingerprint} ({key.name})" for key in usable) or "none"
    release = "" if node.release.has_ed25519 else f" that OpenWrt {node.release} supports"
    return FailedPrecondition(
        f"you could not log in to it afterwards: it gets the keys {', '.join(map(_shown, lines)) or 'none'}; "
        f"your keys{release}: {ours}",
        "name the private key of one of them (--key, ssh.key_files) or load it into your agent, "
        "or add your public key to operators.ssh_keys",
    )


def server_lockout(node: Node, packages: Mapping[str, Package]) -> FailedPrecondition | None:
    """The failed precondition of a configuration (package name -> tree) whose dropbear would not listen after a boot,
    or not on the port where meshctl logs in. A node behind another host (`ssh.host`) may have any port.

    On a running node `Interface` and `DirectInterface` have no effect for a missing network: dropbear listens on all
    addresses (24.10 and later). At boot it waits for that network's trigger forever (dropbear.init, all releases). So
    they may only name a network of the node with a static address.
    """
    dropbear, network = packages.get("dropbear"), packages.get("network")
    if dropbear is None or network is None:
        return None
    steady = {section.name for section in network.of_type("interface") if section.get("proto") == "static"}
    sections = _enabled(dropbear)
    options = ("DirectInterface", "Interface")
    missing = [
        [(option, name) for option in options if (name := section.get(option)) and name not in steady]
        for section in sections
    ]
    if not sections:
        return FailedPrecondition(
            "no login would be possible afterwards: its dropbear is disabled", "remove `enable` from extra_uci"
        )
    ports = listening_ports(dropbear)
    if not node.ssh.host and str(node.ssh.port) not in ports:
        return FailedPrecondition(
            f"no login would be possible afterwards: its dropbear would listen on port {', '.join(ports)}, "
            f"and ssh.port is {node.ssh.port}",
            "remove `Port` from extra_uci",
        )
    if not all(missing):
        return None
    option, name = missing[0][0]
    return FailedPrecondition(
        f"no login would be possible after its next boot: dropbear would wait for {option} {name}, "
        "which is not a network of the node with a static address",
        f"name one of {', '.join(sorted(str(network) for network in steady - {'loopback'})) or 'its networks'}, "
        f"or remove {option} from extra_uci",
    )


def listening_ports(dropbear: Package) -> tuple[str, ...]:
    """The ports of /etc/config/dropbear, in its order; empty if all of its servers are disabled."""
    return tuple(
        dict.fromkeys(port for section in _enabled(dropbear) for port in section.items("Port") or (str(SSH_PORT),))
    )


def _enabled(dropbear: Package) -> list[Section]:
    return [section for section in dropbear.of_type("dropbear") if section.get("enable", "1") not in _OFF]


def firewall_notes(node: Node, packages: Mapping[str, Package]) -> tuple[str, ...]:
    """A note if the firewall zone of the management network refuses new connections, and no rule accepts SSH."""
    firewall, network = packages.get("firewall"), packages.get("network")
    management = None if network is None else management_section(network)
    if firewall is None or management is None:
        return ()
    zones = [zone for zone in firewall.of_type("zone") if management.name in zone.get("network").split()]
    for zone in zones:
        if zone.get("input", "ACCEPT").upper() != "ACCEPT" and not any(
            _accepts_ssh(rule, zone, node.ssh.port) for rule in firewall.of_type("rule")
        ):
            name = zone.get("name") or zone.name
            return (
                f"its firewall zone {name} would {zone.get('input').lower()} new connections, and no rule accepts SSH: "
                "without one, the change is rolled back after the confirm window",
            )
    return ()


def _accepts_ssh(rule: Section, zone: Section, port: int) -> bool:
    """Whether a rule may accept SSH from this zone. Conditions other than zone and port are taken to hold."""
    ports = rule.get("dest_port").split()
    return (
        rule.get("target").upper() == "ACCEPT"
        and rule.get("enabled", "1") not in _OFF
        and not _TCP.isdisjoint((rule.get("proto") or "tcp").lower().split())
        and rule.get("src") in ("*", zone.get("name"))
        and not rule.get("dest")
        and (not ports or any(_includes(word, port) for word in ports))
    )


def _includes(word: str, port: int) -> bool:
    """Whether `22`, `20-30` or `20:30` includes the port; a name does if it is `ssh`."""
    first, _, last = word.replace(":", "-").partition("-")
    if not first.isdigit() or (last and not last.isdigit()):
        return word == "ssh"
    return int(first) <= port <= int(last or first)


def _shown(line: str) -> str:
    """`SHA256:... (comment)` of a line of authorized_keys."""
    words = line.split()
    for index, word in enumerate(words):
        try:
            blob = b64decode(word, validate=True)
        except binascii.Error:
            continue
        # a blob starts with its type, after four bytes of length
        if index and blob[4:].startswith(words[index - 1].encode()):
            comment = " ".join(words[index + 1 :])
            return f"{fingerprint_of(blob)} ({comment})" if comment else fingerprint_of(blob)
    return "an unreadable key"
