"""Keys on the node: authorized_keys, and host keys as `dropbearkey -y` shows them."""

from __future__ import annotations

from meshctl.device.observation import HostKeyInfo
from meshctl.device.trust import parse_key


def parse_authorized_keys(text: str) -> tuple[str, ...]:
    """The lines that are neither empty nor comments, as they are."""
    lines = (line.strip() for line in text.splitlines())
    return tuple(line for line in lines if line and not line.startswith("#"))


def parse_host_keys(text: str) -> tuple[HostKeyInfo, ...]:
    """`dropbearkey -y`: `Public key portion is:`, the key, `Fingerprint: ...` (of a hash that varies by release).

    The fingerprint given here is computed from the key itself.
    """
    found = []
    for line in text.splitlines():
        try:
            key = parse_key(line)
        except ValueError:
            continue
        found.append(HostKeyInfo(key_type=key.key_type, fingerprint=key.fingerprint))
    return tuple(found)
