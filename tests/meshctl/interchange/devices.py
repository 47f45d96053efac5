"""Devices for the tests of the import: rendered by meshctl, recorded, or as `uci export` prints them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from meshctl.interchange.device import MARKER, ExistingDevice, exported_device, parse_marker
from meshctl.interchange.device_entries import ImportOptions
from meshctl.interchange.device_import import DeviceImport, import_device
from meshctl.interchange.new_inventory import load_text, new_text
from meshctl.model import Fleet, Node, Release
from meshctl.render import Rendered
from meshctl.render.compare import placeholder_secret

SSH_KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGxvb25zIGFyZSBhcXVhdGljIGJpcmRz bob"


def rendered_device(fleet: Fleet, node: Node, rendered: Rendered) -> ExistingDevice:
    """The device that has exactly these files."""
    marker = rendered.file(MARKER.lstrip("/"))
    assert marker is not None
    return ExistingDevice(
        {file.package.name: file.package for file in rendered.files if file.package is not None},
        node.release,
        node.hardware.board,
        node.hardware.target,
        lan_ports=node.lan_ports,
        authorized_keys=fleet.operators.ssh_keys,
        marker=parse_marker(marker.content.decode()),
    )


def exported(name: str, *, release: Release = Release.V24_10) -> ExistingDevice:
    """A device of exports/NAME.uci."""
    path = Path(__file__).parent / "exports" / f"{name}.uci"
    return exported_device(
        path.read_text(encoding="utf-8"), path.name, release=release, board="ubnt,rocket-m", target="ath79/generic"
    )


def new_inventory(device: ExistingDevice, directory: Path, **options: Any) -> DeviceImport:
    """The import into a new inventory in `directory`, without writing it."""
    keep = options.pop("keep", ())

    def load(values: Mapping[tuple[str, ...], Any]) -> Fleet:
        return load_text(directory / "fleet.yaml", new_text(values, "a test"))

    return import_device(device, None, ImportOptions(**options), load, placeholder_secret, keep=keep)
