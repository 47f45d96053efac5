"""Firmware images and package files for virtual nodes: small, but validated on the node like real ones.

An image is the text of a virtual flash chip, padded, followed by fwtool's metadata trailer
(docs/facts/openwrt-facts.md section 2), so that host-side checks and `sysupgrade -T` read it like any other.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping

from meshctl.archive import TarMember, tar_of
from meshctl.firmware.trailer import append_metadata
from meshctl.model import Release
from meshlab.releases import ARCH, facts, firmware_text
from meshlab.spec import MESH_PACKAGES


def firmware_image(
    release: Release,
    *,
    board: str,
    extra: tuple[str, ...] = (),
    target: str = "ath79/generic",
    compat_version: str = "1.0",
    size_bytes: int = 256 * 1024,
    revision: str | None = None,
) -> bytes:
    """An image of `release` for `board` (`vendor,model`), at least `size_bytes` long, with the mesh packages and
    `extra` built in."""
    text = firmware_text(release, (*MESH_PACKAGES, *extra), target)
    if revision is not None:
        text = text.replace(facts(release).revision, revision)
    payload = text.encode() + b"--\n"
    devices = "supported_devices" if compat_version == "1.0" else "new_supported_devices"
    metadata = {
        "metadata_version": "1.1",
        "compat_version": compat_version,
        devices: [board],
        "version": {
            "dist": "OpenWrt",
            "version": facts(release).version,
            "revision": revision or facts(release).revision,
            "target": target,
            "board": board.replace(",", "_"),
        },
    }
    return append_metadata(payload.ljust(size_bytes, b"\xff"), metadata)


def opkg_package(
    name: str, version: str, files: Mapping[str, str], *, depends: tuple[str, ...] = (), arch: str = ARCH
) -> bytes:
    """An .ipk with `files` (absolute path -> text, executable)."""
    control = f"Package: {name}\nVersion: {version}\nArchitecture: {arch}\nDepends: {', '.join(('libc', *depends))}\n"
    members = {
        "./debian-binary": b"2.0\n",
        "./control.tar.gz": _tar({"./control": control.encode()}),
        "./data.tar.gz": _tar({f".{path}": text.encode() for path, text in files.items()}),
    }
    return _tar(members)


def apk_package(name: str, version: str, files: Mapping[str, str], *, depends: tuple[str, ...] = ()) -> bytes:
    """A package file for the virtual nodes' apk: a gzipped tar with .PKGINFO (apk 3's own format is binary)."""
    info = f"pkgname = {name}\npkgver = {version}\n" + "".join(f"depend = {need}\n" for need in depends)
    return _tar({".PKGINFO": info.encode()} | {path.lstrip("/"): text.encode() for path, text in files.items()})


def _tar(members: Mapping[str, bytes]) -> bytes:
    return gzip.compress(tar_of(TarMember(path, content, 0o755) for path, content in members.items()), mtime=0)
