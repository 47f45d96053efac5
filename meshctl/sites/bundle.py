"""A site's part of the inventory as one archive, with the files that it names. Reads the operator's files."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from meshctl.archive import TarMember, tar_of
from meshctl.device.trust import Pin, TrustStore, dump_pins
from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError, MeshctlError
from meshctl.file_access import located
from meshctl.inventory.include import read_files
from meshctl.inventory.load import load
from meshctl.inventory.source import Reader
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.sites.part import (
    EARLIER_FILE,
    INVENTORY_FILE,
    KNOWN_HOSTS_FILE,
    SECRETS_FILE,
    PartFile,
    SitePart,
    differences,
    site_part,
)

_TEMPLATES = "templates"


@dataclass(frozen=True, slots=True)
class SiteBundle:
    """`archive` is a tar. `images` maps the paths of firmware images in the part to their SHA-256, and `image_files`
    maps those to the operator's files."""

    archive: bytes = field(repr=False)
    images: Mapping[str, str]
    image_files: Mapping[str, Path]

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.archive).hexdigest()


class PartDiffers(MeshctlError):
    """The part of a site would be read differently from the inventory: a bug in meshctl, found before any change."""


def site_bundle(
    inventory: Path,
    fleet: Fleet,
    site: str,
    secrets: Callable[[SecretRef], Secret],
    trust: TrustStore,
    environ: Mapping[str, str],
    *,
    with_firmware: bool,
    earlier: Mapping[str, Any] | None = None,
) -> SiteBundle:
    """The bundle of one site; `earlier` has the states that a rollback returns its nodes to, as JSON.

    Raises InputError for a missing file or secret.
    """
    root = read_files(inventory, environ).root
    if root is None:
        raise InputError(f"{inventory}: changed while it was being read")
    part = site_part(root, fleet, site, secrets, with_firmware=with_firmware)
    _check(part, fleet, site)
    members = [
        TarMember(INVENTORY_FILE, part.inventory.encode()),
        TarMember(SECRETS_FILE, part.secrets.encode(), 0o600),
    ]
    members.append(TarMember(KNOWN_HOSTS_FILE, _pins(fleet, site, trust).encode()))
    if earlier:
        members.append(TarMember(EARLIER_FILE, json.dumps(dict(earlier)).encode(), 0o600))
    images: dict[str, str] = {}
    image_files: dict[str, Path] = {}
    for file in part.files:
        source = located(file.base or fleet.base, file.written)
        if file.is_image:
            digest = _sha256(source)
            images[file.path], image_files[digest] = digest, source
        else:
            members += _members(file, source)
    own = Path(fleet.base or ".") / _TEMPLATES
    if own.is_dir():
        members += _members(PartFile(_TEMPLATES, _TEMPLATES, fleet.base, is_folder=True), own)
    return SiteBundle(tar_of(members), images, image_files)


def _check(part: SitePart, fleet: Fleet, site: str) -> None:
    def read(path: Path) -> bytes:
        return part.inventory.encode()

    found = list(differences(fleet, _load(read), site))
    if found:
        raise PartDiffers(
            f"site {site}: the part of the inventory for its worker would differ: {', '.join(found[:8])}",
            hint="this is a bug in meshctl; nothing was sent: provision these nodes without the worker",
        )


def _load(read: Reader) -> Fleet:
    loaded = load(Path(INVENTORY_FILE), read=read)
    if loaded.fleet is None:
        raise InvalidInput(loaded.diagnostics)
    return loaded.fleet


def _pins(fleet: Fleet, site: str, trust: TrustStore) -> str:
    """The pinned host keys of the site's nodes, as known_hosts."""
    names = [name for name, node in fleet.nodes.items() if node.site == site]
    return dump_pins(tuple(Pin((name,), key) for name in names for key in trust.pinned(name)))


def _members(file: PartFile, source: Path) -> Iterator[TarMember]:
    paths = sorted(path for path in source.rglob("*") if path.is_file()) if file.is_folder else [source]
    for path in paths:
        name = f"{file.path}/{path.relative_to(source).as_posix()}" if file.is_folder else file.path
        try:
            yield TarMember(name, path.read_bytes(), 0o755 if os.access(path, os.X_OK) else 0o644)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
