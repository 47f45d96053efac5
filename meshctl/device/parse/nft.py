"""`nft list table bridge meshctl_lan`: the table that etc/meshctl/lan-filter.sh loads."""

from __future__ import annotations

import re

from meshctl.device.observation import LanFilterCounts

_DROPPED = re.compile(r"^\s*counter packets (\d+) bytes (\d+) drop\b", re.MULTILINE)


def parse_lan_filter(text: str) -> LanFilterCounts | None:
    """The count of its last rule, which drops what no other rule accepts; None for any other text."""
    found = _DROPPED.search(text)
    return None if found is None else LanFilterCounts(int(found[1]), int(found[2]))
