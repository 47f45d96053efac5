"""Which packages a node needs, and which it takes when the inventory names some."""

from __future__ import annotations

from dataclasses import replace

import pytest

from meshctl.model import Backend, Encryption, Fleet, Mesh, MeshMode, Node, OperatorParts, Release
from meshctl.resolve import PackagePlan, package_needs, package_plan, supplicant_need
from tests.meshctl.render import fleets


def plan(mesh: Mesh, node: Node) -> PackagePlan:
    return package_plan(_fleet(mesh, node), node)


def _fleet(mesh: Mesh, node: Node) -> Fleet:
    return fleets.fleet(node, meshes=(mesh,))


def test_an_open_mesh_needs_batman_and_the_tools() -> None:
    assert plan(fleets.mesh(), fleets.node()) == PackagePlan(("batctl-default", "iw", "kmod-batman-adv"), ())


@pytest.mark.parametrize(
    ("release", "full", "stock"),
    [
        (Release.V19_07, "wpad-mesh-wolfssl", "wpad-basic"),
        (Release.V21_02, "wpad-mesh-wolfssl", "wpad-basic-wolfssl"),
        (Release.V22_03, "wpad-mesh-wolfssl", "wpad-basic-wolfssl"),
        (Release.V23_05, "wpad-mesh-mbedtls", "wpad-basic-mbedtls"),
        (Release.V24_10, "wpad-mesh-mbedtls", "wpad-basic-mbedtls"),
        (Release.V25_12, "wpad-mesh-mbedtls", "wpad-basic-mbedtls"),
    ],
)
def test_an_encrypted_mesh_replaces_the_stock_supplicant_with_a_full_one(
    release: Release, full: str, stock: str
) -> None:
    found = plan(fleets.mesh(mode=MeshMode.MESH, encryption=Encryption.SAE), fleets.node(release))
    assert full in found.install
    assert found.remove == (stock,)


def test_packages_in_the_inventory_replace_the_defaults() -> None:
    node = fleets.node(packages=("wpad-openssl", "batctl-full", "tcpdump", "-ppp"))
    found = plan(fleets.mesh(encryption=Encryption.PSK2), node)
    assert found.install == ("batctl-full", "iw", "kmod-batman-adv", "tcpdump", "wpad-openssl")
    assert found.remove == ("ppp", "wpad-basic-mbedtls")


def test_meshmerize_needs_the_packages_of_its_operator() -> None:
    mesh = replace(
        fleets.mesh(), backend=Backend.MESHMERIZE, operator_parts=OperatorParts(packages=("operator-daemon",))
    )
    needs = package_needs(_fleet(mesh, fleets.node()), fleets.node())
    assert [need.any_of[0] for need in needs] == ["operator-daemon", "iw"]


def test_older_releases_are_not_offered_mbedtls() -> None:
    need = supplicant_need(fleets.mesh(encryption=Encryption.PSK2), Release.V21_02)
    assert need is not None
    assert not any("mbedtls" in name for name in need.any_of)
    assert "ad-hoc" in need.reason


@pytest.mark.parametrize("release", list(Release))
def test_encrypted_802_11s_needs_a_supplicant_with_a_tls_library(release: Release) -> None:
    ad_hoc = supplicant_need(fleets.mesh(encryption=Encryption.PSK2), release)
    mesh = supplicant_need(fleets.mesh(mode=MeshMode.MESH, encryption=Encryption.SAE), release)
    assert ad_hoc is not None
    assert mesh is not None
    assert "wpad" in ad_hoc.any_of
    assert "wpad" not in mesh.any_of
    assert set(mesh.any_of) == set(ad_hoc.any_of) - {"wpad"}
