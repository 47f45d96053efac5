"""Small inventories for the tests, and how to load a text."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

from meshctl.diagnostics import Diagnostic
from meshctl.inventory import Loaded, load
from meshctl.model import Fleet

SHIPPED = Path(__file__).resolve().parents[3] / "inventory"

HEAD = dedent("""\
    meshctl: 1
    fleet: trial
    country: US
    meshes:
      main: {ssid: trial, bssid: 02:ca:fe:00:00:01, band: 2g, channel: 6, network: 10.42.0.0/24}
    hardware:
      rocket:
        board: ubnt,rocket-m
        profile: ubnt_rocket-m
        target: ath79/generic
        release: 23.05
        lan_ports: [eth0]
        radios: {radio0: {path: pci0000:00/0000:00:00.0, band: 2g, rated_power_dbm: 30, max_drive_dbm: 28}}
    """)


def load_text(directory: Path, text: str, **others: str) -> Loaded:
    """Write `text` as fleet.yaml and each of `others` as NAME.yaml, and load them."""
    (directory / "fleet.yaml").write_text(text, encoding="utf-8")
    for name, content in others.items():
        (directory / f"{name}.yaml").write_text(content, encoding="utf-8")
    return load(directory)


def fleet_of(directory: Path, text: str, **others: str) -> Fleet:
    """The fleet of `HEAD` and `text`, which must be right."""
    loaded = load_text(directory, HEAD + dedent(text), **{key: dedent(value) for key, value in others.items()})
    assert loaded.diagnostics == ()
    assert loaded.fleet is not None
    return loaded.fleet


def errors_of(directory: Path, text: str, **others: str) -> tuple[Diagnostic, ...]:
    """The diagnostics of `HEAD` and `text`, which must be wrong."""
    loaded = load_text(directory, HEAD + dedent(text), **{key: dedent(value) for key, value in others.items()})
    assert loaded.fleet is None
    assert loaded.diagnostics
    return loaded.diagnostics
