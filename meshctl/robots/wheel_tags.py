"""Wheel tags and compatibility (PEP 425, 427, 600, 656).

A `Target` is one computer's Python; `WheelName` is a parsed file name; `is_compatible` compares the two;
`pip_options` makes pip download for a target.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

# PEP 600: legacy manylinux aliases and the glibc they require.
_LEGACY_GLIBC = {"manylinux1": (2, 5), "manylinux2010": (2, 12), "manylinux2014": (2, 17)}
_WHEEL = re.compile(
    r"(?P<name>[A-Za-z0-9_.]+)-(?P<version>[A-Za-z0-9_.!+]+)(?:-\d[A-Za-z0-9_.]*)?"
    r"-(?P<pythons>[a-z0-9_.]+)-(?P<abis>[a-z0-9_.]+)-(?P<platforms>[a-z0-9_.]+)\.whl"
)


@dataclass(frozen=True, slots=True)
class Target:
    """`python` is (major, minor); `arch` is that of `uname -m`, or of a 32-bit Python on a 64-bit kernel; `libc` is
    `glibc` or `musl`."""

    python: tuple[int, int]
    arch: str
    libc: str
    libc_version: tuple[int, int]

    def __str__(self) -> str:
        """`CPython 3.11 on x86_64 with glibc 2.36`."""
        version = ".".join(map(str, self.libc_version))
        return f"CPython {self.python[0]}.{self.python[1]} on {self.arch} with {self.libc} {version}"


@dataclass(frozen=True, slots=True)
class WheelName:
    """A parsed wheel file name; `project` is normalized (PEP 503), tags are its alternatives."""

    file: str
    project: str
    version: str
    pythons: tuple[str, ...]
    abis: tuple[str, ...]
    platforms: tuple[str, ...]


def parse_wheel(file: str) -> WheelName | None:
    """Parse a wheel file name; None if it is not one."""
    found = _WHEEL.fullmatch(file)
    if found is None:
        return None
    project = re.sub(r"[-_.]+", "-", found["name"]).lower()
    tags = (tuple(found[part].split(".")) for part in ("pythons", "abis", "platforms"))
    return WheelName(file, project, found["version"], *tags)


def is_compatible(target: Target, wheel: WheelName) -> bool:
    """Whether pip on that computer would accept the wheel."""
    return any(_python_matches(target, python, abi) for python in wheel.pythons for abi in wheel.abis) and any(
        _platform_matches(target, platform) for platform in wheel.platforms
    )


def _python_matches(target: Target, python: str, abi: str) -> bool:
    major, minor = target.python
    found = re.fullmatch(r"(?P<kind>py|cp)(?P<major>\d)(?P<minor>\d*)", python)
    if found is None or int(found["major"]) != major:
        return False
    minimum = int(found["minor"] or 0)
    match abi:
        case "none":
            # a pure-Python wheel for this Python or an older one
            return minimum <= minor if found["kind"] == "py" else minimum == minor or not found["minor"]
        case "abi3":
            return found["kind"] == "cp" and minimum <= minor
        case _:
            return abi == python == f"cp{major}{minor}"


def _platform_matches(target: Target, platform: str) -> bool:
    if platform == "any":
        return True
    if platform == f"linux_{target.arch}":
        return True
    kind, _, _ = platform.partition("_")
    if kind in _LEGACY_GLIBC:
        return (
            target.libc == "glibc"
            and platform == f"{kind}_{target.arch}"
            and _LEGACY_GLIBC[kind] <= target.libc_version
        )
    found = re.fullmatch(r"(manylinux|musllinux)_(\d+)_(\d+)_(\w+)", platform)
    if found is None or found[4] != target.arch:
        return False
    libc = "glibc" if found[1] == "manylinux" else "musl"
    return libc == target.libc and (int(found[2]), int(found[3])) <= target.libc_version


def pip_options(target: Target) -> tuple[str, ...]:
    """Options of `pip download` for another computer, newest platforms first."""
    version = f"{target.python[0]}.{target.python[1]}"
    cp = f"cp{target.python[0]}{target.python[1]}"
    major, newest = target.libc_version
    kind = "manylinux" if target.libc == "glibc" else "musllinux"
    # 5 is manylinux1's glibc 2.5; musllinux begins at 1.1
    oldest = 5 if target.libc == "glibc" else 1
    platforms = [f"{kind}_{major}_{minor}_{target.arch}" for minor in range(newest, oldest - 1, -1)]
    if target.libc == "glibc":
        platforms += [
            f"{name}_{target.arch}"
            for name, needed in sorted(_LEGACY_GLIBC.items(), reverse=True)
            if needed <= target.libc_version
        ]
    tags = [word for platform in platforms for word in ("--platform", platform)]
    return ("--python-version", version, "--implementation", "cp", "--abi", cp, "--abi", "abi3", "--abi", "none", *tags)
