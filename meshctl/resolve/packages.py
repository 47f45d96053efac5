"""The OpenWrt packages that a node needs, and the stock packages that they replace."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from meshctl.model import Backend, Encryption, Fleet, Mesh, MeshMode, Node, Release


@dataclass(frozen=True, slots=True)
class PackageNeed:
    """One of `any_of` must be installed for `reason`; the first is the default."""

    any_of: tuple[str, ...]
    reason: str


@dataclass(frozen=True, slots=True)
class PackagePlan:
    """`install` on top of the stock image, `remove` from it; both sorted."""

    install: tuple[str, ...]
    remove: tuple[str, ...]


def package_plan(fleet: Fleet, node: Node) -> PackagePlan:
    """The packages listed for the node and its hardware, plus those that its meshes need."""
    named = {package for package in (*node.hardware.packages, *node.packages) if not package.startswith("-")}
    dropped = {package[1:] for package in (*node.hardware.packages, *node.packages) if package.startswith("-")}
    for need in package_needs(fleet, node):
        if not named.intersection(need.any_of):
            named.add(need.any_of[0])
    if any(package in FULL_SUPPLICANTS for package in named):
        dropped.add(stock_supplicant(node.release))
    return PackagePlan(tuple(sorted(named)), tuple(sorted(dropped - named)))


def package_files(fleet: Fleet, node: Node) -> tuple[str, ...]:
    """The package files of the node's hardware and of its meshes' back ends, each once."""
    parts = [file for name in node.meshes for file in fleet.meshes[name].operator_parts.package_files]
    return tuple(dict.fromkeys((*node.hardware.package_files, *parts)))


def package_needs(fleet: Fleet, node: Node) -> tuple[PackageNeed, ...]:
    """The needs of the node's meshes, without duplicates, in the meshes' order."""
    needs: dict[PackageNeed, None] = {}
    for name in node.meshes:
        mesh = fleet.meshes[name]
        needs.update(dict.fromkeys(_backend_needs(mesh)))
        supplicant = supplicant_need(mesh, node.release)
        if supplicant is not None:
            needs[supplicant] = None
    needs.update(dict.fromkeys(lan_filter_needs(node)))
    return tuple(needs)


def lan_filter_needs(node: Node) -> Iterator[PackageNeed]:
    """nf_tables for bridges, in every release since 19.07 (package/kernel/linux/modules/netfilter.mk), and nft, which
    firewall4 brings from 22.03 on; nothing without a filter."""
    if node.lan_filter is None or not node.bridges_lan:
        return
    yield PackageNeed(("kmod-nft-bridge",), "the LAN filter works in the bridge")
    if not node.release.has_fw4:
        yield PackageNeed(("nftables-nojson", "nftables-json", "nftables"), "the LAN filter is loaded with nft")


def _backend_needs(mesh: Mesh) -> tuple[PackageNeed, ...]:
    tools = (PackageNeed(("iw", "iw-full"), "meshctl reads the radio's links with it"),)
    match mesh.backend:
        case Backend.BATMAN:
            return (
                PackageNeed(("kmod-batman-adv",), f"mesh {mesh.name} routes with batman-adv"),
                # batctl-tiny has no JSON output and no loop avoidance tables
                PackageNeed(("batctl-default", "batctl-full"), f"meshctl reads the routes of mesh {mesh.name} with it"),
                *tools,
            )
        case Backend.MESHMERIZE:
            reason = f"mesh {mesh.name} routes with meshmerize"
            return (*(PackageNeed((package,), reason) for package in mesh.operator_parts.packages), *tools)


# wpa_supplicant builds with CONFIG_IBSS_RSN; `wpad-basic*` and `wpad-mini` do not have it. SAE and 802.11s are in all
# builds except `wpad`, which has no TLS library (hostapd's Makefile and wpa_supplicant-full.config, 19.07 to 25.12).
_WITHOUT_MESH = "wpad"
FULL_SUPPLICANTS = (
    "wpad-mesh-mbedtls",
    "wpad-mesh-openssl",
    "wpad-mesh-wolfssl",
    "wpad-mbedtls",
    "wpad-openssl",
    "wpad-wolfssl",
    "wpad",
)


def supplicant_need(mesh: Mesh, release: Release) -> PackageNeed | None:
    """The supplicant that an encrypted mesh needs, by default the build with the release's TLS library."""
    if mesh.encryption is Encryption.NONE:
        return None
    library = "mbedtls" if release >= Release.V23_05 else "wolfssl"
    preferred = f"wpad-mesh-{library}"
    offered = tuple(name for name in FULL_SUPPLICANTS if release >= Release.V23_05 or not name.endswith("mbedtls"))
    what = "an encrypted ad-hoc cell" if mesh.mode is MeshMode.ADHOC else "an encrypted 802.11s mesh"
    # without support for it, 23.05 and later silently join the mesh unencrypted (wifi-scripts, mac80211.sh)
    lacking = () if mesh.mode is MeshMode.ADHOC else (_WITHOUT_MESH,)
    rest = tuple(name for name in offered if name != preferred and name not in lacking)
    return PackageNeed((preferred, *rest), f"mesh {mesh.name} is {what}, which wpad-basic cannot join")


def wireless_scripts(release: Release) -> str | None:
    """The package with /usr/share/hostap/wdev.uc, which netifd's mac80211.sh needs for every mesh interface.
    kmod-mac80211 depends on it, so only manually assembled images lack it. None: the release has no such file.

    Source: package/network/services/hostapd/Makefile (23.05), package/network/config/wifi-scripts (main).
    """
    if release >= Release.V24_10:
        return "wifi-scripts"
    return "hostapd-common" if release >= Release.V23_05 else None


def stock_supplicant(release: Release) -> str:
    """The supplicant in the release's stock images, which conflicts with a full build."""
    if release >= Release.V23_05:
        return "wpad-basic-mbedtls"
    return "wpad-basic-wolfssl" if release >= Release.V21_02 else "wpad-basic"
