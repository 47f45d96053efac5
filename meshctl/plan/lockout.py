"""Whether a plan would shut us out: the keys a node is to have against those that we can log in with. Pure.

A node proves its new configuration by letting us in with a key. Where none of ours is among those it gets, its password
login would close behind us, nobody could confirm, and it would go back after its window: better not to begin.
"""

from __future__ import annotations

import binascii
from base64 import b64decode
from collections.abc import Mapping, Sequence

from meshctl.device.connection import OwnKey, fingerprint_of
from meshctl.model import Node
from meshctl.plan.objections import Objection

AUTHORIZED_KEYS = "etc/dropbear/authorized_keys"


def lockout(node: Node, files: Mapping[str, bytes], own: Sequence[OwnKey]) -> Objection | None:
    """The objection against a change to `files` (paths without a leading slash) after which none of `own` would be let
    in, or None."""
    content = files.get(AUTHORIZED_KEYS)
    # dropbear reads this file for root alone
    if content is None or node.ssh.user != "root":
        return None
    lines = [line for line in content.decode("utf-8", "replace").splitlines() if line.strip()]
    allowed = {word for line in lines for word in line.split()}
    # 19.07's dropbear knows RSA alone
    usable = [key for key in own if node.release.has_ed25519 or key.key_type == "ssh-rsa"]
    if any(key.base64 in allowed for key in usable):
        return None
    ours = ", ".join(f"{key.fingerprint} ({key.name})" for key in usable) or "none"
    release = "" if node.release.has_ed25519 else f" that OpenWrt {node.release} knows"
    return Objection(
        f"nobody here could log in to it afterwards: it gets the keys {', '.join(map(_shown, lines)) or 'none'}; "
        f"the keys we have{release}: {ours}",
        "name the private key of one of them (--key, ssh.key_files) or load it into your agent, "
        "or add your public key to operators.ssh_keys",
    )


def _shown(line: str) -> str:
    """`SHA256:... (comment)` of a line of authorized_keys."""
    words = line.split()
    for index, word in enumerate(words):
        try:
            blob = b64decode(word, validate=True)
        except binascii.Error:
            continue
        # a blob begins with its own type, four bytes of length before it
        if index and blob[4:].startswith(words[index - 1].encode()):
            comment = " ".join(words[index + 1 :])
            return f"{fingerprint_of(blob)} ({comment})" if comment else fingerprint_of(blob)
    return "one that cannot be read"
