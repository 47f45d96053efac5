"""Hardware profiles and packages: what the boxes are, and what they need to be part of the mesh (MC821 to MC834)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import PurePath

from meshctl import firmware
from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import join_limited
from meshctl.lint.openwrt_names import SUBTARGETS, TARGETS, chip_target, suggest_package
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.encryption import packages_path
from meshctl.lint.rules.firmware import ROCKET_IMAGE
from meshctl.lint.rules.references import suggest
from meshctl.model import Fleet, Release
from meshctl.resolve import package_needs

# no security fixes any more (openwrt.org/docs/guide-developer/security)
_UNMAINTAINED = (Release.V19_07, Release.V21_02, Release.V22_03, Release.V23_05)
# OpenWrt's own warning: 8/64 devices are the least that current releases run well on
_MIN_MEMORY_MIB = 64
_MIN_FLASH_MIB = 8


@fleet_rule(
    "MC821",
    Severity.ERROR,
    "A package that the mesh needs is taken out",
    why="Nodes come up without the mesh's module or its tools: the image builds, flashes, boots, and never joins.",
    fix="Take the `-` away from the package, or use another mesh back end.",
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
                yield Finding(path, need.reason, f"one of {join_limited(need.any_of)}", f"-{package}")


@fleet_rule(
    "MC822",
    Severity.WARNING,
    "A ready image may lack what the mesh needs",
    why="""The profile names a finished image, and none of the packages that the mesh needs among those in it. Nodes
    have no internet: what is not in the image is not on the node.""",
    fix="List what the image holds in `packages`, or bring the rest as `package_files`.",
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
        brought = [PurePath(file).name for file in profile.package_files]
        for need in package_needs(fleet, node):
            if not named.intersection(need.any_of) and not any(file.startswith(need.any_of) for file in brought):
                path = ("hardware", profile.name, "packages")
                yield Finding(path, need.reason, f"one of {join_limited(need.any_of)}", "none of them")


@fleet_rule(
    "MC823",
    Severity.WARNING,
    "batctl-tiny cannot tell the state of the mesh",
    why="It has no JSON and no tables of loop avoidance: status would show the node without neighbours and routes.",
    fix="Use batctl-default or batctl-full.",
    failing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-tiny, iw, wpad-openssl]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-full, iw, wpad-openssl]}}",
)
def batctl_tiny(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if "batctl-tiny" in (*node.hardware.packages, *node.packages):
            path = packages_path(node, "batctl-tiny")
            yield Finding(path, "status is blind", "batctl-default or batctl-full", "batctl-tiny")


@fleet_rule(
    "MC824",
    Severity.WARNING,
    "A package is both wanted and taken out",
    why="One of two people who edited the profile is wrong about what is on the node.",
    fix="Keep one of the two lines.",
    failing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, tcpdump, -tcpdump]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, tcpdump]}}",
)
def package_contradiction(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        named = (*node.hardware.packages, *node.packages)
        for name in named:
            if name.startswith("-") and name[1:] in named:
                yield Finding(packages_path(node, name), "also wanted", "one of the two", name)


@fleet_rule(
    "MC825",
    Severity.WARNING,
    "Board and profile name different devices",
    why="""The board is what the device calls itself, the profile what the ImageBuilder calls it: the same words with a
    comma or an underscore. When they differ, one was copied from another profile, and the image will be refused.""",
    fix="Read the board off the device: `ubus call system board`.",
    failing="hardware: {rocket: {profile: ubnt_bullet-m-xw}}",
    passing="hardware: {rocket: {profile: ubnt_rocket-m}}",
)
def board_and_profile_differ(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        if profile.board.replace(",", "_") != profile.profile:
            path = ("hardware", profile.name, "profile")
            expected = f"{profile.board.replace(',', '_')} for board {profile.board}"
            yield Finding(path, "not the board's", expected, profile.profile)


@fleet_rule(
    "MC826",
    Severity.ERROR,
    "A target is not of OpenWrt's form",
    why="""The ImageBuilder and the image's own metadata name targets as `ath79/generic`; anything else finds no builder
    and fits no image.""",
    fix="Read the target off the device: `ubus call system board`, release.target.",
    failing="hardware: {rocket: {target: ath79}}",
    passing="hardware: {rocket: {target: ath79/generic}}",
)
def target_form(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        if re.fullmatch(r"[a-z0-9_]+/[a-z0-9_]+", profile.target) is None:
            path = ("hardware", profile.name, "target")
            yield Finding(path, "no target", "a target and a subtarget, such as ath79/generic", profile.target)


@fleet_rule(
    "MC827",
    Severity.NOTE,
    "The release is no longer maintained",
    why="No security fixes: what is found in its kernel, dropbear or wpad stays open on every radio of the fleet.",
    fix="Move to 24.10 or later when the fleet can be tested on it.",
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
    why="""Releases from 22.03 on run out of memory on 32 MiB, and do not fit into 4 MiB of flash with the mesh's
    packages: such nodes reboot under load.""",
    fix="Use other hardware, or an older release for these.",
    failing="hardware: {rocket: {memory_mib: 32}}",
    passing="hardware: {rocket: {memory_mib: 64}}",
)
def device_too_small(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        if profile.release < Release.V22_03:
            continue
        sizes = (
            ("memory_mib", profile.memory_mib, _MIN_MEMORY_MIB),
            ("flash_mib", profile.flash_mib, _MIN_FLASH_MIB),
        )
        for key, size, least in sizes:
            # an image at hand is held against the flash by a rule of its own
            image = firmware.image_path(profile) if key == "flash_mib" else None
            if size < least and (image is None or context.files.size_bytes(image) is None):
                path = ("hardware", profile.name, key)
                yield Finding(path, f"too small for {profile.release}", f"at least {least}", str(size))


@fleet_rule(
    "MC829",
    Severity.WARNING,
    "There is no recipe for recovery",
    why="""It is printed before a device is flashed, and wanted when the flash went wrong: at night, without internet,
    by whoever is there.""",
    fix="Write in `recovery` how this device is brought back: which button, when, at which address.",
    failing="""hardware: {rocket: {recovery: ""}}""",
    passing="hardware: {rocket: {recovery: Hold reset at power-on for 8 s and send the image to 192.168.1.20 by TFTP}}",
)
def no_recovery(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    used = {node.hardware.name for node in fleet.managed()}
    for profile in fleet.hardware.values():
        if profile.name in used and not profile.recovery.strip():
            path = ("hardware", profile.name)
            yield Finding(path, "nobody will know how to bring it back", "`recovery`", "none")


@fleet_rule(
    "MC830",
    Severity.ERROR,
    "A hardware profile has no radio",
    why="A node without a radio is in no mesh. The section was forgotten.",
    fix="Describe its radios by the names of their UCI sections, usually radio0.",
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
    "A robot's switch hangs on another mesh than its computer",
    why="""A node with radios in several networks bridges its wired ports with the one that holds its address. With the
    address in one network and the robot's computer in another, the computer is on the wrong side: it hears nothing.""",
    fix="Give the node an address in its computer's network.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {address: 10.43.0.1, radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    """,
    # the address may well belong to the second radio: which one is radio0 is the board's choice
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {address: 10.43.0.1, radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    robots: {base-station: {computer: {address: 10.43.0.100/24}}}
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
            message = f"the switch of {robot.name} would hang on mesh {holding.name}, its computer is in {meant.name}"
            yield Finding(path, message, f"an address in {meant.network}", str(node.address.ip))


@fleet_rule(
    "MC832",
    Severity.WARNING,
    "A package's name is misspelt",
    why="""The ImageBuilder stops at a package that no feed has, and opkg finds none on the bench. Where the mesh
    needs the package, meshctl adds the right name beside the wrong one.""",
    fix="Correct the name.",
    failing="hardware: {rocket: {packages: [kmod-batman-adb, batctl-default, iw, wpad-openssl]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, my-own-tool]}}",
)
def package_misspelt(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    judged: dict[str, str | None] = {}
    for node in fleet.managed():
        for written in (*node.hardware.packages, *node.packages):
            name = written.removeprefix("-")
            if name not in judged:
                judged[name] = suggest_package(name)
            meant = judged[name]
            if meant is not None:
                hint = f"did you mean {meant}?"
                yield Finding(packages_path(node, written), "no package of this name is known", meant, name, hint)


@fleet_rule(
    "MC833",
    Severity.WARNING,
    "OpenWrt has no such target",
    why="The ImageBuilder is fetched by its target, and an image's metadata names it: with a slip, neither fits.",
    fix="Read the target off the device: `ubus call system board`, release.target.",
    failing="hardware: {rocket: {target: ath97/generic}}",
    passing="hardware: {rocket: {target: ath79/generic}}",
)
def target_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        target, slash, subtarget = profile.target.partition("/")
        path = ("hardware", profile.name, "target")
        if not slash:
            continue
        # OpenWrt gets new ones with each release: only what is near to a known one is taken for a slip
        if target not in TARGETS:
            _, hint = suggest(TARGETS, target)
            if hint:
                yield Finding(path, "no such target", "a target of OpenWrt", profile.target, hint)
        elif target in SUBTARGETS and subtarget not in SUBTARGETS[target]:
            near = get_close_matches(subtarget, sorted(SUBTARGETS[target]), 1)
            for meant in near:
                expected = f"{target}/{meant}"
                yield Finding(path, "no such subtarget", expected, profile.target, f"did you mean {expected}?")


@fleet_rule(
    "MC834",
    Severity.WARNING,
    "The target is of another chip than the radio",
    why="""The radio's path says which chip it is part of. An image for another chip does not boot; forced onto the
    board, it leaves a device that only a serial cable revives.""",
    fix="Read both off the device: release.target of `ubus call system board`, `uci get wireless.radio0.path`.",
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
                message = f"{radio.name} is at {radio.path}"
                yield Finding(("hardware", profile.name, "target"), message, f"{expected}/...", profile.target)
                break
