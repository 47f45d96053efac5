"""Firmware images checked against the inventory, by their own metadata (MC801 to MC812)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePath

from meshctl import firmware
from meshctl.device.deadman import is_package_word
from meshctl.diagnostics import Severity
from meshctl.firmware.check import (
    BAD_SIGNATURE,
    DAMAGED,
    NO_METADATA,
    UNREADABLE,
    WRONG_BOARD,
    WRONG_HASH,
    WRONG_RELEASE,
    WRONG_REVISION,
)
from meshctl.inventory.file_paths import file_path
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Fleet, HardwareProfile, PackageTool

_METADATA = 'image for {"supported_devices":["%s"],"version":{"version":"%s","revision":"%s","target":"ath79/generic"}}'
ROCKET_IMAGE = _METADATA % ("ubnt,rocket-m", "24.10.2", "r28739-d9340319c6")
_BULLET = _METADATA % ("ubnt,bullet-m-xw", "24.10.2", "r28739-d9340319c6")
_OLD = _METADATA % ("ubnt,rocket-m", "23.05.5", "r24106-10cc5fcd00")
_IMAGE = "hardware: {rocket: {firmware: {image: rocket.bin, sha256: <sha256 of rocket.bin>, revision: r28739}}}"
_OTHER_HASH = "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef"
# reserved flash: boot loader, configuration and packages
_FLASH_RESERVE_KIB = 512


def _profiles(fleet: Fleet) -> Iterator[HardwareProfile]:
    """The profiles with an image that a managed node uses."""
    used = {node.hardware.name for node in fleet.managed()}
    return (profile for profile in fleet.hardware.values() if profile.firmware.image and profile.name in used)


def _image_findings(fleet: Fleet, context: LintContext, code: str, *key: str) -> Iterator[Finding]:
    """The image check's findings with `code`, at the profile."""
    for profile in _profiles(fleet):
        for item in context.files.firmware(profile):
            if item.code == code:
                path = ("hardware", profile.name, "firmware", *(key or ("image",)))
                message = f"{Path(item.position.file).name}: {item.message}" if item.message else item.position.file
                yield Finding(path, message, item.expected, item.found, item.hint)


@fleet_rule(
    "MC801",
    Severity.ERROR,
    "A firmware image is missing",
    why="A missing image is otherwise noticed in the field, without internet access to download it.",
    fix="Add the image, or correct the path, which is relative to the file that names it.",
    failing="hardware: {rocket: {firmware: {image: absent.bin, revision: r28739, sha256: HASH}}}".replace(
        "HASH", _OTHER_HASH
    ),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_missing(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, UNREADABLE)


@fleet_rule(
    "MC802",
    Severity.ERROR,
    "A firmware image does not match its SHA-256",
    why="The file is truncated, was replaced by another build, or was tampered with: it is not the tested image.",
    fix="Download the image again; if it was replaced on purpose, update `sha256`.",
    failing=Example(
        f"hardware: {{rocket: {{firmware: {{image: rocket.bin, revision: r28739, sha256: {_OTHER_HASH}}}}}}}",
        files={"rocket.bin": ROCKET_IMAGE},
    ),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_wrong_hash(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, WRONG_HASH, "sha256")


@fleet_rule(
    "MC803",
    Severity.ERROR,
    "A firmware image is damaged",
    why="The image's checksum does not match its contents: at best, sysupgrade rejects it.",
    fix="Download the image again.",
    failing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE.replace("image for", "damaged image for")}),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_damaged(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, DAMAGED)


@fleet_rule(
    "MC804",
    Severity.ERROR,
    "A firmware image has no metadata",
    why="""Without metadata sysupgrade rejects the image (ath79 requires it), and its board cannot be checked. The usual
    cause is a factory image, which is for the manufacturer's boot loader.""",
    fix="Use the image with `sysupgrade` in its name.",
    failing=Example(_IMAGE, files={"rocket.bin": "a factory image"}),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_without_metadata(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, NO_METADATA)


@fleet_rule(
    "MC805",
    Severity.ERROR,
    "A firmware image is for another board",
    why="Forced onto the wrong board, the image leaves a device that only a serial console can recover.",
    fix="Use the image for this profile, or correct the profile's `board` and `target`.",
    failing=Example(_IMAGE, files={"rocket.bin": _BULLET}),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_wrong_board(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, WRONG_BOARD)


@fleet_rule(
    "MC806",
    Severity.ERROR,
    "A firmware image's release differs from the profile's",
    why="""The configuration is rendered for the profile's release: on another release, bridges, radios or the firewall
    come up differently or not at all.""",
    fix="Set the profile's `release` to the image's.",
    failing=Example(_IMAGE.replace("r28739", "r24106"), files={"rocket.bin": _OLD}),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_wrong_release(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, WRONG_RELEASE)


@fleet_rule(
    "MC807",
    Severity.ERROR,
    "A firmware image's revision differs from the profile's",
    why="""After a flash the node must report this revision: with a different one in the image, every flash counts as
    failed.""",
    fix="Set `revision` to that of the image.",
    failing=Example(_IMAGE.replace("revision: r28739", "revision: r24106"), files={"rocket.bin": ROCKET_IMAGE}),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_wrong_revision(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, WRONG_REVISION, "revision")


@fleet_rule(
    "MC808",
    Severity.ERROR,
    "A firmware image's signature is invalid or missing",
    why="""The profile's `usign_key` must have signed the image, but the signature does not match, or the signature or
    the key is missing. OpenWrt does not check it.""",
    fix="Put the release's sha256sums and sha256sums.sig (or the image's own .sig) next to the image.",
    failing=Example(
        _IMAGE.replace("image: rocket.bin", "image: rocket.bin, usign_key: absent.pub"),
        files={"rocket.bin": ROCKET_IMAGE},
    ),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_signature(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    yield from _image_findings(fleet, context, BAD_SIGNATURE, "usign_key")


@fleet_rule(
    "MC809",
    Severity.WARNING,
    "A firmware image has no SHA-256",
    why="Any file of that name would be flashed, even a truncated one.",
    fix="Set `sha256` to the output of `sha256sum IMAGE`.",
    failing=Example(
        "hardware: {rocket: {firmware: {image: rocket.bin, revision: r28739}}}", files={"rocket.bin": ROCKET_IMAGE}
    ),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_without_hash(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in _profiles(fleet):
        if not profile.firmware.sha256:
            path = ("hardware", profile.name, "firmware")
            yield Finding(path, "any file of that name would be flashed", "`sha256`", "none")


@fleet_rule(
    "MC810",
    Severity.ERROR,
    "A firmware image does not fit the flash",
    why="sysupgrade writes until the flash is full: the device does not boot again.",
    fix="Use a smaller image, or correct the profile's `flash_mib`.",
    failing=Example(
        _IMAGE.replace("rocket: {", "rocket: {flash_mib: 4, "), files={"rocket.bin": "4 MiB " + ROCKET_IMAGE}
    ),
    passing=Example(_IMAGE.replace("rocket: {", "rocket: {flash_mib: 4, "), files={"rocket.bin": ROCKET_IMAGE}),
)
def image_too_large(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for profile in _profiles(fleet):
        path = firmware.image_path(profile)
        size = context.files.size_bytes(path) if path is not None else None
        room_kib = profile.flash_mib * 1024 - _FLASH_RESERVE_KIB
        if size is not None and size > room_kib * 1024:
            place = ("hardware", profile.name, "firmware", "image")
            expected = f"at most {room_kib} KiB ({profile.flash_mib} MiB less {_FLASH_RESERVE_KIB} KiB)"
            yield Finding(place, "larger than the flash", expected, f"{-(-size // 1024)} KiB")


@fleet_rule(
    "MC811",
    Severity.ERROR,
    "A package file is missing or of the wrong type",
    why="""opkg (up to 24.10) installs .ipk files, apk (from 25.12) .apk files; with a wrong or missing file, the back
    end is not installed and the node comes up without a mesh.""",
    fix="""Add the package file built for this release, or correct the path, which is relative to the file that names
    it.""",
    failing=Example("hardware: {rocket: {package_files: [tool.apk]}}", files={"tool.apk": "a package"}),
    passing=Example("hardware: {rocket: {package_files: [tool.ipk]}}", files={"tool.ipk": "a package"}),
)
def package_file_wrong(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, names, profile in _package_files(fleet):
        suffix = ".apk" if profile.release.package_tool is PackageTool.APK else ".ipk"
        for index, name in enumerate(names):
            if not name.endswith(suffix):
                message = f"OpenWrt {profile.release} does not install this type"
                yield Finding((*place, str(index)), message, f"a file with {suffix}", name)
            elif not is_package_word(PurePath(name).name):
                yield Finding((*place, str(index)), "not sent to a node", "a file name without blanks and quotes", name)
            elif context.files.size_bytes(file_path(fleet, name)) is None:
                yield Finding((*place, str(index)), "no such file", "a package file", name)


def _package_files(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], tuple[str, ...], HardwareProfile]]:
    for profile in fleet.hardware.values():
        yield ("hardware", profile.name, "package_files"), profile.package_files, profile
    for mesh in fleet.meshes.values():
        parts = mesh.operator_parts
        member = next((node for node in fleet.members(mesh.name)), None) if parts.package_files else None
        if member is not None:
            place = ("meshes", mesh.name, "operator_parts", "package_files")
            yield place, parts.package_files, member.hardware


@fleet_rule(
    "MC812",
    Severity.WARNING,
    "A firmware image has no revision and is never flashed",
    why="""meshctl flashes a node whose revision differs from `revision`, and checks it after the flash. Without
    `revision` the image is never used, and plan, apply and status report no difference.""",
    fix="Set `revision` to release.revision of `ubus call system board` on a node that runs the image.",
    failing=Example(_IMAGE.replace(", revision: r28739", ""), files={"rocket.bin": ROCKET_IMAGE}),
    passing=Example(_IMAGE, files={"rocket.bin": ROCKET_IMAGE}),
)
def image_without_revision(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in _profiles(fleet):
        if not profile.firmware.revision:
            path = ("hardware", profile.name, "firmware")
            yield Finding(path, "the image is never flashed", "`revision`", "none")
