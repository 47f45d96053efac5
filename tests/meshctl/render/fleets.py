"""Fleets for the tests of resolve and render: one node of every shape, as values."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Address, IPv4Interface, IPv4Network
from types import MappingProxyType
from typing import Any

from meshctl.diagnostics import Position
from meshctl.model import (
    ApplyPolicy,
    Band,
    Computer,
    Encryption,
    Fleet,
    HardwareProfile,
    Mesh,
    MeshMode,
    Node,
    NodeState,
    Operators,
    Origin,
    Radio,
    RadioHardware,
    Release,
    Robot,
    Role,
    Secret,
    SecretKind,
    SecretRef,
    SystemSettings,
    UdpMesh,
)

RSA = "ssh-rsa AAAAB3NzaC1yc2EAAAADAQABAAABAQC7 alice"
ED25519 = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGxvb25zIGFyZSBhcXVhdGljIGJpcmRz bob"
KEY = "correct horse battery"
KEY_REF = SecretRef(SecretKind.ENV, "MESH_KEY")

RADIO_2G = RadioHardware("radio0", "pci0000:00/0000:00:00.0", Band.G2, 30, 27, antenna_gain_dbi=5)
RADIO_5G = RadioHardware("radio1", "platform/ahb/18100000.wmac", Band.G5, 27, 24)


def secrets(ref: SecretRef) -> Secret:
    """The only key of these fleets."""
    assert ref == KEY_REF
    return Secret(KEY)


def mesh(**changes: Any) -> Mesh:
    """A mesh as in docs/facts, with fields changed; `encryption` brings its key."""
    usual = Mesh("main", "fleet", "02:ca:fe:00:00:01", Band.G2, 6, IPv4Network("10.42.0.0/24"))
    if changes.get("encryption", Encryption.NONE) is not Encryption.NONE:
        changes.setdefault("key", KEY_REF)
    return replace(usual, **changes)


def hardware(release: Release, **changes: Any) -> HardwareProfile:
    """A WPJ344 with a radio in each band."""
    usual = HardwareProfile(
        "wpj344",
        "compex,wpj344-16m",
        "compex_wpj344-16m",
        "ath79/generic",
        release,
        (RADIO_2G, RADIO_5G),
        ("eth0.1",),
        switch_vlans=(("1", "3 0t"), ("2", "2 0t")),
    )
    return replace(usual, **changes)


def node(release: Release = Release.V23_05, **changes: Any) -> Node:
    """A robot's radio with its first radio in `main` and its second switched off."""
    profile = hardware(release)
    usual = Node(
        name="husky1-front",
        hostname="husky1-front",
        role=Role.ROBOT,
        state=NodeState.CARRIED,
        hardware=profile,
        release=release,
        address=IPv4Interface("10.42.0.11/24"),
        radios=(Radio(RADIO_2G, "main", 27), Radio(RADIO_5G, None, 20)),
        lan_ports=("eth0.1",),
        robot="husky1",
        label="H1F",
    )
    return replace(usual, **changes)


def fleet(*nodes: Node, meshes: tuple[Mesh, ...] = (), **changes: Any) -> Fleet:
    """The nodes in one fleet; every value is said to stand in fleet.yaml, line 1."""
    known = meshes or (mesh(),)
    members = nodes or (node(),)
    usual = Fleet(
        name="test-fleet",
        country="US",
        meshes=MappingProxyType({item.name: item for item in known}),
        hardware=MappingProxyType({item.hardware.name: item.hardware for item in members}),
        nodes=MappingProxyType({item.name: item for item in members}),
        robots=MappingProxyType({"husky1": Robot("husky1", tuple(item.name for item in members))}),
        topics=(),
        udp_mesh=UdpMesh(),
        operators=Operators((RSA, ED25519)),
        system=SystemSettings(log_host="10.42.0.100", ntp_servers=("10.42.0.100",)),
        apply=ApplyPolicy(),
        provenance=origins(known, members),
        files=("fleet.yaml",),
    )
    return replace(usual, **changes)


def routed_lans(release: Release = Release.V23_05) -> Fleet:
    """Two robots with LANs of their own and the operator's bridged one: the node of `husky1` routes."""
    router = node(release, gateway=IPv4Address("10.42.0.254"), lan_address=IPv4Interface("10.43.1.1/24"))
    other = replace(router, name="spot-radio", robot="spot", address=IPv4Interface("10.42.0.12/24"), gateway=None)
    other = replace(other, lan_address=IPv4Interface("10.43.2.1/24"))
    base = replace(
        node(release), name="base", robot="base-station", role=Role.BASE, address=IPv4Interface("10.42.0.1/24")
    )
    robots = {
        "base-station": Robot("base-station", ("base",), Computer(IPv4Interface("10.42.0.100/24")), is_base=True),
        "husky1": Robot(
            "husky1", (router.name,), Computer(IPv4Interface("10.43.1.10/24")), lan=IPv4Network("10.43.1.0/24")
        ),
        "spot": Robot("spot", (other.name,), Computer(IPv4Interface("10.43.2.10/24")), lan=IPv4Network("10.43.2.0/24")),
    }
    return fleet(router, other, base, meshes=(mesh(),), robots=MappingProxyType(robots))


def origins(meshes: tuple[Mesh, ...], nodes: tuple[Node, ...]) -> MappingProxyType[tuple[str, ...], Origin]:
    """Every mesh and node on a line of its own."""
    lines = [("meshes", item.name) for item in meshes] + [("nodes", item.name) for item in nodes]
    places = {path: Origin(Position("fleet.yaml", line, 3), "node") for line, path in enumerate(lines, 10)}
    return MappingProxyType(places)


def modes(release: Release) -> dict[str, Mesh]:
    """Every kind of cell that a release can join, by the golden files' names for them."""
    cells = {
        "adhoc": mesh(),
        "mesh": mesh(mode=MeshMode.MESH),
        "mesh-sae": mesh(mode=MeshMode.MESH, encryption=Encryption.SAE),
    }
    if release < Release.V25_12:
        cells["adhoc-psk2"] = mesh(encryption=Encryption.PSK2)
    return cells
