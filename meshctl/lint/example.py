"""Examples as inventories: a rule's fragment merged into a small fleet without findings.

`compose` returns the text of the whole inventory; `write` writes it and its files to a directory. Mappings merge key by
key, other values replace, `<removed>` removes a key. A fragment with a comment is appended unchanged, for rules about
text.
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from meshctl.firmware import append_metadata
from meshctl.inventory.compose import LOADER
from meshctl.lint.rule import Example

REMOVED = "<removed>"

_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

BASE = """\
meshctl: 1
fleet: example
country: US
operators:
  ssh_keys: [ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f alice]
hardware:
  rocket:
    board: ubnt,rocket-m
    profile: ubnt_rocket-m
    target: ath79/generic
    release: "24.10"
    lan_ports: [eth0]
    packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl]
    recovery: Hold reset at power-on for 8 s, then send the image to 192.168.1.20 by TFTP.
    radios:
      radio0:
        path: pci0000:00/0000:00:00.0
        band: 2g
        rated_power_dbm: 28
        max_drive_dbm: 28
        antenna_gain_dbi: 5
      radio1:
        path: pci0000:00/0000:00:01.0
        band: 5g
        rated_power_dbm: 20
        max_drive_dbm: 20
        antenna_gain_dbi: 3
meshes:
  main:
    ssid: fleet
    bssid: 02:ca:fe:00:00:01
    band: 2g
    channel: 6
    network: 10.42.0.0/24
    encryption: psk2+ccmp
    key: {env: MESH_KEY}
defaults:
  hardware: rocket
  state: spare
  radios: {radio1: {mesh: null}}
nodes:
  base:
    role: base
    state: deployed
    address: 10.42.0.1
    label: BASE
    mac: 00:15:6d:00:00:01
    host_keys: [ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8A]
  husky1-front: {role: robot, state: carried, address: 10.42.0.11, label: H1F}
  b01: {role: beacon, state: carried, address: 10.42.0.101, label: B1}
robots:
  base-station:
    is_base: true
    nodes: [base]
    computer: {address: 10.42.0.100/24, ssh: {user: operator}}
  husky1:
    nodes: [husky1-front]
    carries: [b01]
    computer: {address: 10.42.0.110/24, ssh: {user: robot}}
udp_mesh:
  keys: [{env: UDP_MESH_KEY}]
topics:
  estop:
    {priority: 0, class: emergency_stop, type: std_msgs/Bool, sources: [base-station], rate_hz: 0.1, size_bytes: 20}
  commands:
    {priority: 1, class: command, type: std_msgs/String, sources: [base-station], destinations: [husky1]}
  artifacts:
    priority: 3
    class: artifact
    type: std_msgs/String
    sources: [husky1]
    destinations: [base-station]
    rate_hz: 0.02
    size_bytes: 60000
  telemetry: {priority: 5, class: telemetry, reliable: false, rate_hz: 2, size_bytes: 400}
  map: {priority: 7, class: map, sources: [husky1], destinations: [base-station], rate_hz: 0.1, size_bytes: 20000}
  video:
    priority: 9
    class: video
    reliable: false
    sources: [husky1]
    destinations: [base-station]
    rate_hz: 1
    size_bytes: 5000
"""

# secrets of the base inventory, unless the example overrides them
ENVIRONMENT = {
    "MESH_KEY": "cedar-lantern-93-quarry",
    "UDP_MESH_KEY": "b4f8e7f0c3a94c21a1d2d9a0f5c36e7722d1b6c8e3f04a5b9c7d8e1f2a3b4c5d",
}

# a file text with this prefix describes an image with the metadata that follows
_IMAGE = "image for "
_DAMAGED = "damaged image for "
_LARGE = "4 MiB image for "


def compose(example: Example) -> str:
    """The example's whole inventory."""
    if "#" in example.fragment:
        return BASE + example.fragment
    whole = _merged(_read(BASE), _read(example.fragment))
    return _with_hashes(yaml.dump(whole, Dumper=_DUMPER, sort_keys=False, allow_unicode=True, width=110), example.files)


def write(example: Example, directory: Path) -> Path:
    """Write the inventory and its files; returns the path to lint. Files named `mode-0644...` get that mode."""
    for name, text in example.files.items():
        file = directory / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content(text))
        file.chmod(int(name[5:9], 8) if name.startswith("mode-") else 0o600)
    path = directory / "fleet.yaml"
    path.write_text(compose(example), encoding="utf-8")
    return path


def environment(example: Example) -> dict[str, str]:
    """The environment variables with the example's secrets."""
    return {**ENVIRONMENT, **example.environment}


def content(text: str) -> bytes:
    """The content of an example file: its text, or the image that the text describes."""
    for prefix, start in ((_IMAGE, b"kernel"), (_DAMAGED, b"kernel"), (_LARGE, b"\0" * (4 << 20))):
        if text.startswith(prefix):
            image = append_metadata(start, json.loads(text.removeprefix(prefix)))
            return b"K" + image[1:] if prefix == _DAMAGED else image
    return text.encode()


def _read(text: str) -> dict[str, Any]:
    document: dict[str, Any] = yaml.load(text, Loader=LOADER)
    return document


def _merged(base: dict[str, Any], fragment: Mapping[str, Any]) -> dict[str, Any]:
    whole = copy.deepcopy(base)
    for key, value in fragment.items():
        if value == REMOVED:
            whole.pop(key, None)
        elif isinstance(value, dict) and isinstance(whole.get(key), dict) and not _is_secret(value):
            whole[key] = _merged(whole[key], value)
        else:
            whole[key] = value
    return whole


def _is_secret(value: Mapping[str, Any]) -> bool:
    return bool(value.keys() & {"env", "file", "age"})


def _with_hashes(text: str, files: Mapping[str, str]) -> str:
    for name, described in files.items():
        text = text.replace(f"<sha256 of {name}>", hashlib.sha256(content(described)).hexdigest())
    return text
