"""Debian packages for the machine: resolved and downloaded by apt, unpacked by dpkg-deb, never installed on the host.

`sources` -> `update` -> `resolve` -> `download` -> `unpack`, none of which needs root. The machine uses packages of
Debian 12 (bookworm) only, so that it is the same everywhere. On a bookworm host apt uses the host's own sources; on any
other host (Ubuntu, another Debian) it uses a list in the lab's cache, verified with Debian's archive keyring. `resolve`
runs against an empty dpkg status, so packages installed on the host do not count.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from meshlab.errors import LabError

CODENAME = "bookworm"
OS_RELEASE = Path("/etc/os-release")
# from the package debian-archive-keyring of Debian and Ubuntu
KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
MIRROR = "http://deb.debian.org/debian"
# names another mirror, for networks with a mirror of their own
MIRROR_VARIABLE = "MESHCTL_LAB_DEBIAN"
# the kernel with drivers, 802.11 and bridges: that of cloud images has no mac80211_hwsim
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
    "nftables",
    # the cryptography wheel needs it; with it udp_mesh runs on the robots' computers
    "python3-cffi-backend",
    "python3-minimal",
    "python3-yaml",
    "tcpdump",
    "wireless-regdb",
    "wpasupplicant",
)
# used by maintainer scripts only, which are not run
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
# an unresponsive mirror must not block a start forever
_DOWNLOAD_S = 300.0
_HINT = "run scripts/setup-lab to prepare the host; set MESHCTL_LAB_DEBIAN to use another mirror of Debian bookworm"


@dataclass(frozen=True, slots=True)
class ResolvedPackages:
    """File names of the packages in apt's archive cache; `kernel` is the name of the kernel's package."""

    archives: tuple[str, ...]
    kernel: str


@dataclass(frozen=True, slots=True)
class Apt:
    """apt with its own state in the directory `work`, and the options `sources` that `sources()` returned."""

    work: Path
    sources: Mapping[str, str]

    def get(self, archives: Path, *arguments: str, folder: Path | None = None) -> str:
        """Run `apt-get` with its archives in `archives`; returns its output. Raises LabError when it fails."""
        return _run(("apt-get", *self._options(archives), *arguments), folder)

    def cache(self, *arguments: str) -> str:
        return _run(("apt-cache", *self._options(self.work), *arguments))

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


def codename(os_release: str) -> str:
    """VERSION_CODENAME of /etc/os-release, empty if missing."""
    found = re.search(r'^VERSION_CODENAME="?([^"\n]*)"?$', os_release, re.MULTILINE)
    return found[1] if found else ""


def distribution(os_release: str) -> str:
    """PRETTY_NAME of /etc/os-release, such as `Ubuntu 24.04.1 LTS`."""
    found = re.search(r'^PRETTY_NAME="?([^"\n]*)"?$', os_release, re.MULTILINE)
    return found[1] if found else "this distribution"


def sources(cache: Path, environ: Mapping[str, str] = os.environ, os_release: Path = OS_RELEASE) -> dict[str, str]:
    """The apt options for bookworm's packages: none on a bookworm host, else `Dir::*` of a source list in `cache`,
    which needs `update`. Raises LabError when apt could not verify the packages."""
    text = os_release.read_text(encoding="utf-8") if os_release.exists() else ""
    mirror = environ.get(MIRROR_VARIABLE, "")
    if codename(text) == CODENAME and not mirror:
        return {}
    if not KEYRING.exists():
        raise LabError(
            f"the lab's machine is built from Debian packages ({CODENAME}), but {distribution(text)} has no {KEYRING}",
            hint="run scripts/setup-lab, or `apt install debian-archive-keyring`",
        )
    lists = cache / "lists"
    (lists / "partial").mkdir(parents=True, exist_ok=True)
    listed = cache / "sources.list"
    listed.write_text(f"deb [arch=amd64 signed-by={KEYRING}] {mirror or MIRROR} {CODENAME} main\n", encoding="ascii")
    return {
        "Dir::Etc::sourcelist": str(listed),
        "Dir::Etc::sourceparts": "-",
        # the host's pinning does not apply to these packages
        "Dir::Etc::preferences": "-",
        "Dir::Etc::preferencesparts": "-",
        "Dir::State::lists": str(lists),
    }


def update(apt: Apt) -> None:
    """Fetch the package lists of `apt.sources`; the host's own lists are not updated."""
    if apt.sources:
        apt.get(apt.work, "-qq", "update")


def resolve(apt: Apt) -> ResolvedPackages:
    """Resolve `PACKAGES` and the kernel with all dependencies. Raises LabError when apt has no lists of Debian."""
    empty = apt.work / "empty"
    (empty / "partial").mkdir(parents=True, exist_ok=True)
    listed = apt.get(empty, "-qq", "--print-uris", "--no-install-recommends", "install", *PACKAGES)
    archives = [line.split()[1] for line in listed.splitlines() if line.startswith("'")]
    depends = apt.cache("depends", KERNEL_META)
    kernels = [line.split()[-1] for line in depends.splitlines() if "Depends: linux-image-" in line]
    if not kernels:
        raise LabError(f"apt found no kernel that {KERNEL_META} depends on", hint=_HINT)
    return ResolvedPackages(tuple(name for name in archives if not name.startswith(_UNNEEDED)), kernels[0])


def download(resolved: ResolvedPackages, apt: Apt, cache: Path) -> None:
    """Download the packages that are missing in the directory `cache`."""
    (cache / "partial").mkdir(parents=True, exist_ok=True)
    apt.get(cache, "-qq", "-y", "--no-install-recommends", "--download-only", "install", *PACKAGES)
    if not list(cache.glob(f"{resolved.kernel}_*.deb")):
        apt.get(cache, "-qq", "download", resolved.kernel, folder=cache)


def unpack(resolved: ResolvedPackages, cache: Path, root: Path) -> None:
    """Unpack the packages into the new directory `root`, without documentation and other unused files. No link leads
    out of it."""
    root.mkdir(parents=True)
    for name in resolved.archives:
        _unpack_one(cache / name, root)
    for pattern in _EXCLUDED:
        for path in root.glob(pattern):
            shutil.rmtree(path)
    keep_links_inside(root)


def keep_links_inside(root: Path) -> None:
    """Make absolute links relative: on the host they lead out of `root`, to the loader and programs of the host."""
    for folder, folders, files in os.walk(root):
        for link in (Path(folder, name) for name in (*folders, *files)):
            target = os.readlink(link) if link.is_symlink() else ""
            if target.startswith("/"):
                link.unlink()
                link.symlink_to(os.path.relpath(f"{root}{target}", folder))


def unpack_kernel(resolved: ResolvedPackages, cache: Path, target: Path) -> None:
    """Unpack the kernel's package into `target`: boot/vmlinuz-*, lib/modules/*."""
    target.mkdir(parents=True)
    _unpack_one(next(iter(sorted(cache.glob(f"{resolved.kernel}_*.deb")))), target)


def _unpack_one(archive: Path, root: Path) -> None:
    try:
        _run(("dpkg-deb", "-x", str(archive), str(root)))
    except LabError as error:
        raise LabError(
            f"cannot unpack {archive}: {error}", hint="remove it; the next start downloads it again"
        ) from error


def _run(command: Sequence[str], folder: Path | None = None) -> str:
    if shutil.which(command[0]) is None:
        raise LabError(
            f"building the lab's machine needs {command[0]}, which is not installed", hint="use a Debian or Ubuntu host"
        )
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=_DOWNLOAD_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise LabError(f"{command[0]} did not finish within {_DOWNLOAD_S:g} s", hint=_HINT) from error
    if done.returncode != 0:
        lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise LabError(
            f"{command[0]} failed for the lab's machine: {lines[-1] if lines else done.returncode}", hint=_HINT
        )
    return done.stdout
