"""Files and small tools of the system itself: /etc/openwrt_release, /proc/*, df, date, /sys/class/net."""

from __future__ import annotations

import re
from types import MappingProxyType

from meshctl.device.observation import Bridge, Load, Memory, ReleaseInfo, Sensors, Space

_ASSIGNMENT = re.compile(r"""^DISTRIB_([A-Z]+)=(['"]?)(.*)\2\s*$""", re.MULTILINE)
_MEMINFO = re.compile(r"^(\w+):\s+(\d{1,15}) kB$", re.MULTILINE)
_MAC = re.compile(r"[0-9a-fA-F]{2}(?::[0-9a-fA-F]{2}){5}")
_BOOT_ID = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_BACKLOG = re.compile(r"/sys/kernel/debug/ieee80211/(phy\d{1,3})/aqm:R fq_backlog (\d{1,9})")
_TEMPERATURE = re.compile(r"/sys/class/(?:ieee80211|thermal)/(phy\d{1,3}|thermal_zone\d{1,3})/\S+?:(-?\d{1,7})")
_NUMBER = re.compile(r"\d{1,12}(?:\.\d{1,9})?")


def parse_openwrt_release(text: str) -> ReleaseInfo | None:
    """/etc/openwrt_release: `DISTRIB_RELEASE='19.07.10'` and the lines around it."""
    values = {match[1]: match[3] for match in _ASSIGNMENT.finditer(text)}
    if "RELEASE" not in values:
        return None
    return ReleaseInfo(
        distribution=values.get("ID", ""),
        version=values["RELEASE"],
        revision=values.get("REVISION", ""),
        target=values.get("TARGET", ""),
        description=values.get("DESCRIPTION", ""),
    )


def parse_uptime(text: str) -> float | None:
    """/proc/uptime: seconds since boot, then idle seconds."""
    return _first_number(text)


def parse_clock(text: str) -> float | None:
    """`date +%s`."""
    return _first_number(text)


def _first_number(text: str) -> float | None:
    words = text.split()
    return float(words[0]) if words and _NUMBER.fullmatch(words[0]) else None


def parse_boot_id(text: str) -> str | None:
    """/proc/sys/kernel/random/boot_id."""
    return text.strip() if _BOOT_ID.fullmatch(text.strip()) else None


def parse_load(text: str) -> Load | None:
    """/proc/loadavg, then the number of processors on a line of its own (1 where the kernel numbers none)."""
    lines = text.split("\n")
    minute = _first_number(lines[0])
    if minute is None or len(lines) < 2 or not re.fullmatch(r"\d{1,5}", lines[1].strip()):
        return None
    return Load(minute, max(1, int(lines[1])))


def parse_sensors(text: str) -> Sensors:
    """`PATH:LINE` of debugfs' aqm (`R fq_backlog 12`) and of temperature files; other lines are left out."""
    queued: dict[str, int] = {}
    temperatures: dict[str, float] = {}
    for line in text.splitlines():
        if found := _BACKLOG.fullmatch(line):
            queued[found[1]] = int(found[2])
        elif found := _TEMPERATURE.fullmatch(line):
            # a radio has one sensor, which it may show in two places
            temperatures[found[1]] = int(found[2]) / 1000
    return Sensors(MappingProxyType(queued), MappingProxyType(temperatures))


def parse_phys(text: str) -> dict[str, tuple[str, str]]:
    """`phy0 PATH DRIVER`, the driver possibly missing -> radio -> (path, driver)."""
    lines = (line.split(" ") for line in text.splitlines())
    return {words[0]: (words[1], words[2]) for words in lines if len(words) == 3}


def parse_meminfo(text: str) -> Memory | None:
    """/proc/meminfo, in bytes; a kernel without MemAvailable counts free, buffers and cache."""
    kib = {match[1]: int(match[2]) for match in _MEMINFO.finditer(text)}
    if "MemTotal" not in kib or "MemFree" not in kib:
        return None
    available = kib.get("MemAvailable", kib["MemFree"] + kib.get("Buffers", 0) + kib.get("Cached", 0))
    return Memory(total=kib["MemTotal"] << 10, free=kib["MemFree"] << 10, available=available << 10)


def parse_df(text: str) -> dict[str, Space] | None:
    """`df -k PATHS`: mount point -> its space. busybox breaks the row of a long device name in two."""
    words = text.split()
    found: dict[str, Space] = {}
    for index, word in enumerate(words):
        if index < 4 or index + 1 >= len(words) or not re.fullmatch(r"\d{1,3}%", word):
            continue
        total, available = words[index - 3], words[index - 1]
        if total.isdecimal() and available.isdecimal() and len(total) < 16 and len(available) < 16:
            path = words[index + 1]
            found.setdefault(path, Space(path=path, total=int(total) << 10, free=int(available) << 10))
    return found or None


def parse_first_boot(text: str) -> bool:
    """The lines of /proc/mounts about /, and that of sysupgrade's archive: whether / is the memory that stands in for
    flash at a first boot (fstools, overlay.c), or the archive that the next boot unpacks is there."""
    lines = text.splitlines()
    return "/sysupgrade.tgz" in lines or any(line.startswith("overlayfs:/tmp/root / ") for line in lines)


def parse_read_only_root(text: str) -> bool:
    """The lines of /proc/mounts about /: whether nothing can be written below it, as in failsafe mode (the ROM image
    alone) or after errors of the flash. The last mount is the one in use."""
    rows = [line.split() for line in text.splitlines() if line.split()[1:2] == ["/"]]
    return bool(rows) and len(rows[-1]) > 3 and "ro" in rows[-1][3].split(",")


def parse_macs(text: str) -> dict[str, str] | None:
    """`NAME ADDRESS INDEX` lines of observe.sh as name -> address; an interface without one is left out."""
    rows = [line.split() for line in text.splitlines()]
    found = {row[0]: row[1].lower() for row in rows if len(row) in (2, 3) and _MAC.fullmatch(row[1])}
    return found or None


def parse_indexes(text: str) -> dict[int, str]:
    """The same lines as interface index -> name."""
    rows = [line.split() for line in text.splitlines()]
    return {int(row[2]): row[0] for row in rows if len(row) == 3 and row[2].isdecimal() and len(row[2]) < 10}


def parse_bridges(text: str) -> tuple[Bridge, ...]:
    """`NAME PORT...` lines of observe.sh."""
    rows = [line.split() for line in text.splitlines()]
    return tuple(Bridge(name=row[0], ports=tuple(row[1:])) for row in rows if row)


def parse_mode(text: str) -> int | None:
    """The permission bits of `ls -ln`'s first column: `-rw-r--r--` is 0o644."""
    flags = text.split(" ", 1)[0].strip()
    if not re.fullmatch(r"[-bcdlps][-r][-w][-xsS][-r][-w][-xsS][-r][-w][-xtT][+.@]?", flags):
        return None
    bits = 0
    for flag in flags[1:10]:
        bits = bits << 1 | (flag not in "-ST")
    for position, value in ((3, 0o4000), (6, 0o2000), (9, 0o1000)):
        bits |= value if flags[position] in "sStT" else 0
    return bits
