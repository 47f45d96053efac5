"""Hardware profiles, their packages and targets (MC821 to MC835)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import PurePath

from meshctl import firmware
from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.openwrt_names import SUBTARGETS, SUCCESSORS, TARGETS, chip_target, suggest_packages
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.encryption import packages_path
from meshctl.lint.rules.firmware import ROCKET_IMAGE
from meshctl.lint.rules.references import suggest
from meshctl.model import Fleet, HardwareProfile, Release
from meshctl.resolve import package_files, package_needs
from meshctl.suggest import nearest, suggestion
from meshctl.wording import one_of

# no security fixes (openwrt.org/docs/guide-developer/security)
_UNMAINTAINED = (Release.V19_07, Release.V21_02, Release.V22_03, Release.V23_05)
# fw3 and what filters beside nftables; iptables-nft and its modules translate to it
_FW3 = re.compile(r"firewall|ip6?tables(-legacy|-zz-legacy)?")
# since 23.05 (package/network/services/hostapd/Makefile)
_MBEDTLS = re.compile(r"(wpad|wpa-supplicant|hostapd)(-basic|-mesh|-mini)?-mbedtls")
# OpenWrt's 4/32 warning: 8 MiB flash and 64 MiB RAM are the minimum
_MIN_MEMORY_MIB = 64
_MIN_FLASH_MIB = 8
# targets with one image for all boards, or profiles that are not named after the device tree (target/linux/*/image)
_OTHER_PROFILE_NAMES = ("x86", "armsr", "armvirt", "malta", "bcm27xx", "octeon")


@fleet_rule(
    "MC821",
    Severity.ERROR,
    "A package that the mesh needs is removed",
    why="The image builds, flashes and boots without the mesh's kernel module or tools, and the node never joins.",
    fix="Remove the `-` from the package, or use another mesh back end.",
    failing="hardware: {rocket: {packages: [-kmod-batman-adv, iw, wpad-openssl]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, iw, wpad-openssl]}}",
)
def needed_package_removed(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if not all(name in fleet.meshes for name in node.meshes):
            continue
        named = (*node.hardware.packages, *node.packages)
        dropped = {name[1:] for name in named if name.startswith("-")}
        if not dropped:
            continue
        for need in package_needs(fleet, node):
            if dropped.issuperset(need.any_of) or (need.any_of[0] in dropped and not set(named) & set(need.any_of)):
                package = next(name for name in need.any_of if name in dropped)
                path = packages_path(node, f"-{package}")
                yield Finding(path, need.reason, one_of(need.any_of), f"-{package}")


@fleet_rule(
    "MC822",
    Severity.WARNING,
    "A prebuilt image may lack required packages",
    why="""The profile names a prebuilt image, but none of the packages that the mesh needs are listed. Nodes have no
    internet access to install them.""",
    fix="List the image's packages in `packages`, or add the missing ones as `package_files`.",
    failing=Example(
        """
        hardware:
          rocket:
            packages: [iw, wpad-openssl]
            firmware: {image: rocket.bin, sha256: <sha256 of rocket.bin>, revision: r28739}
        """,
        files={"rocket.bin": ROCKET_IMAGE},
    ),
    passing=Example(
        """
        hardware:
          rocket:
            packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl]
            firmware: {image: rocket.bin, sha256: <sha256 of rocket.bin>, revision: r28739}
        """,
        files={"rocket.bin": ROCKET_IMAGE},
    ),
)
def image_lacks_packages(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        profile = node.hardware
        if not profile.firmware.image or not all(name in fleet.meshes for name in node.meshes):
            continue
        named = {*profile.packages, *node.packages}
        brought = [PurePath(file).name for file in package_files(fleet, node)]
        for need in package_needs(fleet, node):
            if not named.intersection(need.any_of) and not any(file.startswith(need.any_of) for file in brought):
                path = ("hardware", profile.name, "packages")
                yield Finding(path, need.reason, one_of(need.any_of), "none of them")


@fleet_rule(
    "MC823",
    Severity.WARNING,
    "batctl-tiny cannot report the state of the mesh",
    why="It has no JSON output and no loop avoidance tables: status would show no neighbors and no routes.",
    fix="Use batctl-default or batctl-full.",
    failing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-tiny, iw, wpad-openssl]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-full, iw, wpad-openssl]}}",
)
def batctl_tiny(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if "batctl-tiny" in (*node.hardware.packages, *node.packages):
            path = packages_path(node, "batctl-tiny")
            yield Finding(path, "status cannot read the mesh", "batctl-default or batctl-full", "batctl-tiny")


@fleet_rule(
    "MC824",
    Severity.WARNING,
    "A package is both added and removed",
    why="One of the two entries has no effect, so the intended content of the image is unclear.",
    fix="Keep one of the two entries.",
    failing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, tcpdump, -tcpdump]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, tcpdump]}}",
)
def package_contradiction(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        named = (*node.hardware.packages, *node.packages)
        for name in named:
            if name.startswith("-") and name[1:] in named:
                yield Finding(packages_path(node, name), "also added", "one of the two", name)


@fleet_rule(
    "MC825",
    Severity.WARNING,
    "Board and profile name different devices",
    why="""`board` is the device's own name, `profile` the ImageBuilder's: the same words with a comma or an underscore.
    If they differ, one was probably copied from another profile, and the image will be rejected. Without the comma
    after its vendor, a board is that of no device, and `plan` refuses every node.""",
    fix="Correct `board` or `profile`; `ubus call system board` on the device prints its board.",
    failing="hardware: {rocket: {profile: ubnt_bullet-m-xw}}",
    passing="hardware: {rocket: {profile: ubnt_rocket-m}}",
)
def board_and_profile_differ(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        if profile.target.partition("/")[0] in _OTHER_PROFILE_NAMES:
            continue
        if "," not in profile.board and "_" in profile.profile:
            path = ("hardware", profile.name, "board")
            yield Finding(path, "no comma after the vendor", profile.profile.replace("_", ",", 1), profile.board)
        elif profile.board.replace(",", "_") != profile.profile:
            path = ("hardware", profile.name, "profile")
            expected = f"{profile.board.replace(',', '_')} for board {profile.board}"
            yield Finding(path, "does not match the board", expected, profile.profile)


@fleet_rule(
    "MC826",
    Severity.ERROR,
    "A target is malformed",
    why="""The ImageBuilder and the image metadata use targets such as `ath79/generic`; anything else matches no builder
    and no image.""",
    fix="Read the target from the device: release.target of `ubus call system board`.",
    failing="hardware: {rocket: {target: ath79}}",
    passing="hardware: {rocket: {target: ath79/generic}}",
)
def target_form(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        if re.fullmatch(r"[a-z0-9_]+/[a-z0-9_]+", profile.target) is None:
            path = ("hardware", profile.name, "target")
            yield Finding(path, "malformed target", "a target and a subtarget, such as ath79/generic", profile.target)


@fleet_rule(
    "MC827",
    Severity.NOTE,
    "The release is no longer maintained",
    why="""It gets no security fixes: vulnerabilities in its kernel, dropbear or wpad stay open on every radio of the
    fleet.""",
    fix="Upgrade to 24.10 or later when the fleet can be tested on it.",
    failing="""hardware: {rocket: {release: "22.03"}}""",
    passing="""hardware: {rocket: {release: "24.10"}}""",
)
def release_unmaintained(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    used = {node.hardware.name for node in fleet.managed()}
    for profile in fleet.hardware.values():
        if profile.release in _UNMAINTAINED and profile.name in used:
            path = ("hardware", profile.name, "release")
            yield Finding(path, "gets no security fixes", "24.10 or later", str(profile.release))


@fleet_rule(
    "MC828",
    Severity.WARNING,
    "The device is too small for the release",
    why="""Releases from 22.03 on run out of memory with 32 MiB: such nodes reboot under load. In 4 MiB of flash, an
    image of any release leaves no room for the mesh's packages, unless it is built without what the node does not
    need.""",
    fix="""Use other hardware. For 32 MiB of memory, an older release works, too. For 4 MiB of flash, build a smaller
    image and name it in `firmware`: its size is compared with the flash.""",
    failing="hardware: {rocket: {memory_mib: 32}}",
    passing="hardware: {rocket: {memory_mib: 64}}",
)
def device_too_small(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        if profile.release >= Release.V22_03 and profile.memory_mib < _MIN_MEMORY_MIB:
            yield _too_small(profile, "memory_mib", _MIN_MEMORY_MIB, profile.memory_mib)
        # MC810 checks the size of an existing image
        image = firmware.image_path(profile)
        if profile.flash_mib < _MIN_FLASH_MIB and (image is None or context.files.size_bytes(image) is None):
            yield _too_small(profile, "flash_mib", _MIN_FLASH_MIB, profile.flash_mib)


def _too_small(profile: HardwareProfile, key: str, least: int, size: int) -> Finding:
    return Finding(("hardware", profile.name, key), f"too small for {profile.release}", f"at least {least}", str(size))


@fleet_rule(
    "MC829",
    Severity.WARNING,
    "A hardware profile has no recovery instructions",
    why="""meshctl prints them before a device is flashed. They are needed when the flash fails, often without internet
    access.""",
    fix="Describe in `recovery` how to revive the device: which button, when, at which address.",
    failing="""hardware: {rocket: {recovery: ""}}""",
    passing="hardware: {rocket: {recovery: Hold reset at power-on for 8 s and send the image to 192.168.1.20 by TFTP}}",
)
def no_recovery(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    used = {node.hardware.name for node in fleet.managed()}
    for profile in fleet.hardware.values():
        if profile.name in used and not profile.recovery.strip():
            path = ("hardware", profile.name)
            yield Finding(path, "no recovery instructions", "`recovery`", "none")


@fleet_rule(
    "MC830",
    Severity.ERROR,
    "A hardware profile has no radio",
    why="A node without a radio can join no mesh.",
    fix="Describe its radios under the names of their UCI sections, usually radio0.",
    failing=Example(
        """
        hardware: {box: {board: "x,box", profile: x_box, target: ath79/generic, release: "24.10", lan_ports: [eth0],
                         radios: {}}}
        """,
        also=("MC109",),
    ),
    passing="hardware: {rocket: {memory_mib: 64}}",
)
def profile_without_radio(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        if not profile.radios:
            yield Finding(("hardware", profile.name, "radios"), "no radio", "at least one", "none")


@fleet_rule(
    "MC831",
    Severity.WARNING,
    "A robot's switch is bridged to another mesh than its computer's",
    why="""A node with radios in several networks bridges its wired ports to the network of its own address. A robot's
    computer in another network receives nothing.""",
    fix="Give the node an address in its computer's network.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {address: 10.43.0.1, radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    """,
    # the address may belong to the second radio: the board defines which one is radio0
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {address: 10.43.0.1, radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    robots: {base-station: {computer: {address: 10.43.0.100/24, links: [{address: 10.42.0.100}]}}}
    """,
)
def switch_on_other_mesh(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        robot = fleet.robots.get(node.robot)
        meshes = [fleet.meshes[name] for name in node.meshes if name in fleet.meshes]
        holding = next((mesh for mesh in meshes if node.address.ip in mesh.network), None)
        if robot is None or robot.computer is None or holding is None or not node.lan_ports:
            continue
        computer = robot.computer.address.ip
        meant = next((mesh for mesh in meshes if computer in mesh.network), None)
        if meant is not None and computer not in holding.network:
            path = ("nodes", node.name, "address")
            message = f"{robot.name}: switch bridged to mesh {holding.name}, but the computer is in {meant.name}"
            yield Finding(path, message, f"an address in {meant.network}", str(node.address.ip))


@fleet_rule(
    "MC832",
    Severity.WARNING,
    "A package name is misspelled",
    why="""The ImageBuilder fails on an unknown package, and opkg does not find it. If the mesh needs the package,
    meshctl adds the correct name next to the misspelled one.""",
    fix="Correct the name.",
    failing="hardware: {rocket: {packages: [kmod-batman-adb, batctl-default, iw, wpad-openssl]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, my-own-tool]}}",
)
def package_misspelt(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    judged: dict[str, tuple[str, ...]] = {}
    for node in fleet.managed():
        for written in (*node.hardware.packages, *node.packages):
            name = written.removeprefix("-")
            if name not in judged:
                judged[name] = suggest_packages(name)
            if meant := judged[name]:
                yield Finding(
                    packages_path(node, written), "unknown package", " or ".join(meant), name, suggestion(meant)
                )


@fleet_rule(
    "MC833",
    Severity.WARNING,
    "The OpenWrt target is unknown",
    why="""The ImageBuilder is selected by target, and the image metadata contains it: a misspelled target, or one that
    the release no longer has, matches neither.""",
    fix="Read the target from the device: release.target of `ubus call system board`.",
    failing="hardware: {rocket: {target: ath97/generic}}",
    passing="hardware: {rocket: {target: ath79/generic}}",
)
def target_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        target, _, subtarget = profile.target.partition("/")
        path = ("hardware", profile.name, "target")
        # releases add targets: report only names similar to a known one (and MC826 a target without a subtarget)
        if target not in TARGETS and subtarget:
            if hint := suggest(TARGETS, target)[1]:
                yield Finding(path, "unknown target", "a target of OpenWrt", profile.target, hint)
        elif target in SUCCESSORS and profile.release >= Release.V21_02:
            expected = f"{SUCCESSORS[target]}/{subtarget}"
            yield Finding(path, f"OpenWrt {profile.release} has no {target}", expected, profile.target)
        elif target in SUBTARGETS and subtarget not in SUBTARGETS[target]:
            near = [f"{target}/{known}" for known in nearest(subtarget, sorted(SUBTARGETS[target]))]
            if near:
                yield Finding(path, "unknown subtarget", " or ".join(near), profile.target, suggestion(near))


@fleet_rule(
    "MC834",
    Severity.WARNING,
    "The target does not match the radio's chip",
    why="""The radio's path identifies its chip. An image for another chip does not boot; forced onto the board, it
    leaves a device that only a serial console can recover.""",
    fix="Read both from the device: release.target of `ubus call system board`, and `uci get wireless.radio0.path`.",
    failing="""
    hardware: {rocket: {target: ramips/mt7621, radios: {radio0: {path: platform/ahb/18100000.wmac}}}}
    """,
    passing="""
    hardware: {rocket: {target: ath79/generic, radios: {radio0: {path: platform/ahb/18100000.wmac}}}}
    """,
)
def target_of_other_chip(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        target = profile.target.partition("/")[0]
        for radio in profile.radios:
            expected = chip_target(radio.path)
            if expected is not None and target in TARGETS and target != expected:
                path = ("hardware", profile.name, "target")
                yield Finding(path, f"{radio.name} is at {radio.path}", f"{expected}/...", profile.target)
                break


@fleet_rule(
    "MC835",
    Severity.WARNING,
    "A package does not fit the OpenWrt release",
    why="""The ImageBuilder fails on a package that the release does not have. From 22.03 on the firewall is nftables
    (`firewall4`): beside it, rules of iptables filter the same frames a second time, and `firewall` does not read the
    configuration that meshctl renders for that release.""",
    fix="""Remove it: each release's image has its own firewall and supplicant. For programs that call iptables, use
    `iptables-nft`.""",
    failing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, firewall]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, firewall4]}}",
)
def package_of_other_release(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        for name in (*node.hardware.packages, *node.packages):
            reason, expected = _misfit(name, node.release)
            if reason:
                yield Finding(packages_path(node, name), f"OpenWrt {node.release} {reason}", expected, name)


def _misfit(package: str, release: Release) -> tuple[str, str]:
    """Why a package does not fit, and what does; empty if it does, or if it is unknown."""
    if package == "firewall4" and not release.has_fw4:
        return "has no firewall4", "firewall"
    if _FW3.fullmatch(package) and release.has_fw4:
        return "filters with nftables", "firewall4" if package == "firewall" else "iptables-nft, or none"
    if _MBEDTLS.fullmatch(package) and release < Release.V23_05:
        return (
            "has no supplicant with mbedtls",
            "wpad-basic"
            if package == "wpad-basic-mbedtls" and release < Release.V21_02
            else package.replace("mbedtls", "wolfssl"),
        )
    return "", ""
