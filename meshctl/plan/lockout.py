"""Whether a plan would lock the operator out: a node's authorized keys, and its SSH server after a boot. Pure.

A change is confirmed over a login with a key. Without one of the operator's keys on the node it could never be
confirmed and would roll back after its window, so it is refused.
"""

from __future__ import annotations

import binascii
from base64 import b64decode
from collections.abc import Mapping, Sequence

from meshctl.device.connection import OwnKey, fingerprint_of
from meshctl.model import Node
from meshctl.plan.preconditions import FailedPrecondition
from meshctl.uci import Package

# the values that libubox treats as false
_OFF = frozenset({"0", "off", "false", "no", "disabled"})
AUTHORIZED_KEYS = "etc/dropbear/authorized_keys"


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


def server_lockout(packages: Mapping[str, Package]) -> FailedPrecondition | None:
    """The failed precondition of a configuration (package name -> tree) whose dropbear would not listen after a boot.

    On a running node `Interface` and `DirectInterface` have no effect for a missing network: dropbear listens on all
    addresses (24.10 and later). At boot it waits for that network's trigger forever (dropbear.init, all releases). So
    they may only name a network of the node with a static address.
    """
    dropbear, network = packages.get("dropbear"), packages.get("network")
    if dropbear is None or network is None:
        return None
    steady = {section.name for section in network.of_type("interface") if section.get("proto") == "static"}
    sections = [section for section in dropbear.of_type("dropbear") if section.get("enable", "1") not in _OFF]
    options = ("DirectInterface", "Interface")
    missing = [
        [(option, name) for option in options if (name := section.get(option)) and name not in steady]
        for section in sections
    ]
    if not sections:
        return FailedPrecondition(
            "no login would be possible afterwards: its dropbear is disabled", "remove `enable` from extra_uci"
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
