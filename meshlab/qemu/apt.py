"""Debian's packages for the machine: resolved and downloaded by apt, unpacked by dpkg-deb, installed nowhere.

`update` fetches apt's lists where the host has none of Debian's (`debian.sources`); `resolve` asks apt against an empty
dpkg status, so that what is installed on this machine does not count; `download` fetches what the cache lacks; `unpack`
lays the files into a directory. No step needs root.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from meshlab.errors import LabError

# drivers, 802.11 and bridges: the kernel of cloud images has no mac80211_hwsim
KERNEL_META = "linux-image-amd64"
PACKAGES = (
    "batctl",
    "busybox-static",
    "dash",
    "dropbear-bin",
    "iperf3",
    "iproute2",
    "iputils-ping",
    "iw",
    "libpython3-stdlib",
    # what cryptography's own wheel needs of the machine's Python: with it udp_mesh runs on robots' computers
    "python3-cffi-backend",
    "python3-minimal",
    "python3-yaml",
    "tcpdump",
    "wireless-regdb",
    "wpasupplicant",
)
# maintainer scripts are not run, so nothing calls their tools
_UNNEEDED = (
    "adduser", "debconf", "debianutils", "dpkg", "gcc-", "init-system-helpers", "libaudit", "libdb5", "libfile-find",
    "libgdbm", "libnumber-compare", "libpam", "libperl", "libsemanage", "libsepol", "libtext-glob", "media-types",
    "passwd", "perl", "readline-common", "tar_", "usrmerge",
)  # fmt: skip
_EXCLUDED = (
    "usr/share/bash-completion", "usr/share/bug", "usr/share/dbus-1", "usr/share/doc", "usr/share/doc-base",
    "usr/share/info", "usr/share/lintian", "usr/share/locale", "usr/share/man", "usr/share/perl*",
    "usr/lib/systemd", "lib/systemd", "usr/lib/x86_64-linux-gnu/gconv", "usr/lib/x86_64-linux-gnu/perl-base",
    "usr/lib/python3.*/ensurepip", "usr/lib/python3.*/lib2to3", "usr/lib/python3.*/pydoc_data",
    "usr/lib/python3.*/idlelib", "usr/lib/python3.*/distutils", "usr/lib/python3.*/unittest",
)  # fmt: skip
# a mirror that answers is quick; one that does not must not hold a start for ever
_DOWNLOAD_S = 300.0
_HINT = (
    "scripts/setup-lab prepares the host; the packages are Debian's (bookworm), MESHCTL_LAB_DEBIAN names another mirror"
)


@dataclass(frozen=True, slots=True)
class ResolvedPackages:
    """File names of the packages in apt's archive cache; `kernel` is the name of the kernel's package."""

    archives: tuple[str, ...]
    kernel: str


@dataclass(frozen=True, slots=True)
class Apt:
    """apt as this module calls it: `work` is a directory of the caller's, `sources` are `debian.sources`."""

    work: Path
    sources: Mapping[str, str]

    def get(self, archives: Path, *words: str, folder: Path | None = None) -> str:
        """`apt-get` with its archives in `archives`; what it prints. Raises LabError."""
        return _run(("apt-get", *self._options(archives), *words), folder)

    def cache(self, *words: str) -> str:
        return _run(("apt-cache", *self._options(self.work), *words))

    def _options(self, archives: Path) -> tuple[str, ...]:
        status = self.work / "status"
        status.touch()
        options = {
            **self.sources,
            "Dir::State::status": status,
            "Dir::Cache::archives": archives,
            "Dir::Cache::pkgcache": "",
            "Dir::Cache::srcpkgcache": "",
            "Debug::NoLocking": "1",
            "APT::Sandbox::User": "",
        }
        return tuple(word for name, value in options.items() for word in ("-o", f"{name}={value}"))


def update(apt: Apt) -> None:
    """Fetch the lists that belong to `apt.sources`; the host's own are its own business."""
    if apt.sources:
        apt.get(apt.work, "-qq", "update")


def resolve(apt: Apt) -> ResolvedPackages:
    """What `PACKAGES` and the kernel mean today. Raises LabError when apt has no lists of Debian's."""
    empty = apt.work / "empty"
    (empty / "partial").mkdir(parents=True, exist_ok=True)
    listed = apt.get(empty, "-qq", "--print-uris", "--no-install-recommends", "install", *PACKAGES)
    archives = [line.split()[1] for line in listed.splitlines() if line.startswith("'")]
    depends = apt.cache("depends", KERNEL_META)
    kernels = [line.split()[-1] for line in depends.splitlines() if "Depends: linux-image-" in line]
    if not kernels:
        raise LabError(f"apt knows no kernel behind {KERNEL_META}", hint=_HINT)
    return ResolvedPackages(tuple(name for name in archives if not name.startswith(_UNNEEDED)), kernels[0])


def download(resolved: ResolvedPackages, apt: Apt, cache: Path) -> None:
    """Put the packages that are not there yet into the directory `cache`."""
    (cache / "partial").mkdir(parents=True, exist_ok=True)
    apt.get(cache, "-qq", "-y", "--no-install-recommends", "--download-only", "install", *PACKAGES)
    if not list(cache.glob(f"{resolved.kernel}_*.deb")):
        apt.get(cache, "-qq", "download", resolved.kernel, folder=cache)


def unpack(resolved: ResolvedPackages, cache: Path, root: Path) -> None:
    """Lay the packages' files into the new directory `root`, without what a machine without users does not read."""
    root.mkdir(parents=True)
    for name in resolved.archives:
        _unpack_one(cache / name, root)
    for pattern in _EXCLUDED:
        for path in root.glob(pattern):
            shutil.rmtree(path)


def unpack_kernel(resolved: ResolvedPackages, cache: Path, target: Path) -> None:
    """Lay the kernel's package into `target`: boot/vmlinuz-*, lib/modules/*."""
    target.mkdir(parents=True)
    _unpack_one(next(iter(sorted(cache.glob(f"{resolved.kernel}_*.deb")))), target)


def _unpack_one(archive: Path, root: Path) -> None:
    try:
        _run(("dpkg-deb", "-x", str(archive), str(root)))
    except LabError as error:
        raise LabError(f"{archive} cannot be unpacked: {error}", hint="remove it: the next start fetches it") from error


def _run(words: Sequence[str], folder: Path | None = None) -> str:
    if shutil.which(words[0]) is None:
        raise LabError(f"the lab's machine is made of Debian packages, and {words[0]} is not here")
    try:
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=_DOWNLOAD_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise LabError(f"{words[0]} did not end within {_DOWNLOAD_S:g} s") from error
    if done.returncode != 0:
        complaint = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise LabError(
            f"{words[0]} failed for the lab's machine: {complaint[-1] if complaint else done.returncode}",
            hint=_HINT,
        )
    return done.stdout
