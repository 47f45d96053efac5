"""Memory and flash of devices (MC837)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet

# the most that boards of these chips have: DDR2 and DDR3 controllers of 32 bits, SPI and NAND flash
_MAX_MEMORY_MIB = 512
_MAX_FLASH_MIB = 1024
_SMALL_TARGETS = frozenset({"ar71xx", "ath25", "ath79", "bmips", "lantiq", "ramips", "realtek"})


@fleet_rule(
    "MC837",
    Severity.WARNING,
    "A device has more memory or flash than its target supports",
    why="""With too large a size, lint and provisioning do not notice that an image, a package or a change does not fit:
    the device notices.""",
    fix="Set the size in MiB, as in the data sheet: 64 for 64 MiB, not 65536 (KiB).",
    failing="hardware: {rocket: {memory_mib: 65536}}",
    passing="hardware: {rocket: {memory_mib: 64}}",
)
def size_above_target(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        target = profile.target.partition("/")[0]
        sizes = (("memory_mib", profile.memory_mib, _MAX_MEMORY_MIB), ("flash_mib", profile.flash_mib, _MAX_FLASH_MIB))
        for key, size, most in sizes:
            if target in _SMALL_TARGETS and size > most:
                hint = f"write {size // 1024} if {size} is in KiB" if size % 1024 == 0 else ""
                path = ("hardware", profile.name, key)
                yield Finding(path, f"no {target} device has that much", f"at most {most}", str(size), hint)
