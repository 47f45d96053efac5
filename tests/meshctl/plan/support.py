"""A small fleet from a real inventory, and observations of nodes that run (or do not run) what it wants."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from meshctl.device.observation import BoardInfo, ChangeStatus, FileInfo, MeshNeighbor, Observation, ReleaseInfo
from meshctl.inventory import load_fleet
from meshctl.model import Fleet, Node, Secret, SecretRef
from meshctl.plan import DesiredState, NodePlan, node_plan
from meshctl.plan.masking import Fingerprints
from meshctl.plan.packages import Needs
from meshctl.render import render_node
from meshctl.topology import Graph, Link, graph_of

SALT = b"0123456789abcdef"
FINGERPRINTS = Fingerprints(SALT)
PASS_PHRASE = "correct horse battery staple"
INVENTORY = """\
meshctl: 1
fleet: team
country: US
operators: {{ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJq0l2c0Z5vZ0xk4r5b1m0mA1s7Qm4m5c8o6u8hQm0Zt alice"]}}
apply: {{max_down: {max_down}, canary: {canary}}}
hardware:
  box:
    board: compex,wpj344-16m
    profile: compex_wpj344-16m
    target: ath79/generic
    release: "23.05"
    lan_ports: [eth0]
    radios:
      radio0: {{path: platform/ahb/18100000.wmac, band: 2g, rated_power_dbm: 30, max_drive_dbm: 27}}
    {firmware}
meshes:
  main:
    ssid: team
    bssid: 02:ca:fe:00:00:01
    band: 2g
    channel: {channel}
    encryption: psk2+ccmp
    key: {{env: MESH_KEY}}
    network: 10.42.0.0/24
defaults: {{hardware: box, state: deployed}}
nodes:
  base: {{role: base, address: 10.42.0.1}}
  b[01-05]: {{role: beacon, address: {{from: 10.42.0.101}}}}
"""


@cache
def fleet(*, channel: int = 6, max_down: int = 1, canary: bool = False, firmware: str = "") -> Fleet:
    """A base and five beacons in one encrypted mesh."""
    text = INVENTORY.format(channel=channel, max_down=max_down, canary=str(canary).lower(), firmware=firmware)
    return _loaded(text)


@cache
def two_meshes(*, channel: int = 6, far_channel: int = 36) -> Fleet:
    """A base and b01 in mesh `main`, b03 and b04 in mesh `far`, b02 in both."""
    text = INVENTORY.format(channel=channel, max_down=1, canary="false", firmware="")
    head, _, _ = text.partition("defaults:")
    radio = "radio1: {path: platform/ahb/18100000.pcie, band: 5g, rated_power_dbm: 30, max_drive_dbm: 27}"
    head = head.replace("max_drive_dbm: 27}\n", f"max_drive_dbm: 27}}\n      {radio}\n", 1)
    head += f"""  far:
    ssid: far
    bssid: 02:ca:fe:00:00:02
    band: 5g
    channel: {far_channel}
    encryption: psk2+ccmp
    key: {{env: MESH_KEY}}
    network: 10.42.0.0/24
"""
    main, far = "{radio1: {mesh: null}}", "{radio0: {mesh: null}}"
    nodes = f"""defaults: {{hardware: box, state: deployed}}
nodes:
  base: {{role: base, address: 10.42.0.1, radios: {main}}}
  b01: {{role: beacon, address: 10.42.0.101, radios: {main}}}
  b02: {{role: beacon, address: 10.42.0.102}}
  b03: {{role: beacon, address: 10.42.0.103, radios: {far}}}
  b04: {{role: beacon, address: 10.42.0.104, radios: {far}}}
"""
    return _loaded(head + nodes)


def _loaded(text: str) -> Fleet:
    with TemporaryDirectory() as directory:
        path = Path(directory) / "fleet.yaml"
        path.write_text(text, encoding="utf-8")
        return load_fleet(path)


def secret(ref: SecretRef) -> Secret:
    return Secret(PASS_PHRASE)


def wanted(team: Fleet, name: str) -> DesiredState:
    rendered = render_node(team, name, secret)
    needs = Needs(tuple((package,) for package in rendered.packages), rendered.removed_packages)
    return DesiredState(team.nodes[name], rendered.files, (PASS_PHRASE,), needs)


def running(
    team: Fleet, name: str, *, neighbors: Iterable[str] = ("02:00:00:00:01:00",), **changes: Any
) -> Observation:
    """An observation of a node that runs exactly what `team` wants of it; `changes` replace fields."""
    want = wanted(team, name)
    node = team.nodes[name]
    uci = {file.package.name: file.content.decode() for file in want.files if file.package is not None}
    files = {
        f"/{file.path}": FileInfo(
            f"/{file.path}", file.mode, hashlib.sha256(file.content).hexdigest(), file.content.decode()
        )
        for file in want.files
        if file.package is None
    }
    seen = Observation(
        asked_at_s=1000.0,
        answered_at_s=1000.2,
        release=ReleaseInfo("OpenWrt", f"{node.release.value}.3", "r23809", node.hardware.target),
        board=BoardInfo(node.hardware.board),
        boot_id="boot",
        uptime_s=500.0,
        macs={"eth0": "02:00:00:00:00:10"},
        neighbors=tuple(MeshNeighbor(mac, "mesh0", 100) for mac in neighbors),
        packages={"hostapd-common": "1"} | {name: "1" for group in want.needs.any_of for name in group},
        uci=uci,
        uci_changes=(),
        files=files,
        change=ChangeStatus("idle"),
    )
    return replace(seen, **changes)


def factory(team: Fleet, name: str) -> Observation:
    """A factory device: stock wireless, disabled; stock network."""
    stock = {
        "wireless": "config wifi-device 'radio0'\n\toption path 'platform/ahb/18100000.wmac'\n\toption disabled '1'\n",
        "network": "config interface 'lan'\n\toption proto 'static'\n\toption ipaddr '192.168.1.1'\n",
        "system": "config system\n\toption hostname 'OpenWrt'\n",
    }
    return running(team, name, neighbors=(), uci=stock, files={})


def planned(team: Fleet, name: str, seen: Observation | None, **options: Any) -> NodePlan:
    return node_plan(wanted(team, name), seen, FINGERPRINTS, **options)


def plans(team: Fleet, seen: Mapping[str, Observation | None]) -> dict[str, NodePlan]:
    return {name: planned(team, name, observation) for name, observation in seen.items()}


def graph(*pairs: str, quality: float = 0.9) -> Graph:
    """`graph("base-b01", "b01-b02")`."""
    ends = [pair.partition("-") for pair in pairs]
    return graph_of([], [Link(a, b, quality) for a, _, b in ends])


def node(team: Fleet, name: str) -> Node:
    return team.nodes[name]
