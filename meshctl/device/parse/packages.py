"""Installed packages: `NAME VERSION` from a package database, `opkg list-installed`, or `apk list --installed`."""

from __future__ import annotations

import re

# apk: `batctl-full-2025.4-r1 mips_24kc {feeds/batctl} (GPL-2.0-only) [installed]`; a version starts with a digit
_APK = re.compile(r"^(\S+?)-(\d\S*) \S+ \{.*\[installed\]")
_PLAIN = re.compile(r"^([A-Za-z0-9][\w.+-]*)(?: -)? (\S*\d\S*)$")


def parse_packages(text: str) -> dict[str, str] | None:
    """Package -> version, None when no line is understood."""
    found: dict[str, str] = {}
    for line in text.splitlines():
        if row := _APK.match(line) or _PLAIN.match(line.strip()):
            found[row[1]] = row[2]
    return found or None


def parse_package_tool(text: str) -> str | None:
    """`command -v apk || command -v opkg`."""
    name = text.strip().rsplit("/", 1)[-1]
    return name if name in {"apk", "opkg"} else None
