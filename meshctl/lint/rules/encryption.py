"""Encryption of the radio link against mode, release and supplicant (MC401 to MC410)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.model import Encryption, Fleet, Mesh, MeshMode, Node, Release
from meshctl.resolve import FULL_SUPPLICANTS, supplicant_need
from meshctl.wording import counted, join_limited, one_of

# a shorter passphrase can be guessed offline from a recorded handshake
_MIN_PASSPHRASE_CHARACTERS = 16


def _members(fleet: Fleet) -> Iterator[tuple[Node, Mesh]]:
    for node in fleet.managed():
        for name in node.meshes:
            if name in fleet.meshes:
                yield node, fleet.meshes[name]


@fleet_rule(
    "MC401",
    Severity.ERROR,
    "OpenWrt 25.12 joins an encrypted ad-hoc cell without encryption",
    why="""The wifi script of 25.12 reads the cipher before it is set, so an ad-hoc cell with a key is joined without
    encryption. Nothing shows it: the configuration says psk2 and the node is in the mesh, but any other device can
    join, too.""",
    fix="Use `mode: mesh` with `encryption: sae`, an earlier release, or an explicit `encryption: none`.",
    failing="""hardware: {rocket: {release: "25.12"}}""",
    passing="""
    hardware: {rocket: {release: "25.12"}}
    meshes: {main: {mode: mesh, encryption: sae}}
    """,
)
def encrypted_adhoc_on_25_12(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    trapped = group_by_key(
        (mesh.name, node.name)
        for node, mesh in _members(fleet)
        if mesh.mode is MeshMode.ADHOC and mesh.encryption is Encryption.PSK2 and node.release >= Release.V25_12
    )
    for name, nodes in trapped.items():
        message = f"silently joined without encryption by nodes on 25.12: {join_limited(nodes)}"
        yield Finding(
            ("meshes", name, "encryption"), message, "none, or mode mesh with sae", "psk2+ccmp in ad-hoc mode"
        )


@fleet_rule(
    "MC402",
    Severity.ERROR,
    "An encrypted mesh has no key",
    why="The supplicant does not start without a key and the radio stays out of the mesh.",
    fix="Reference the key: `key: {env: MESH_KEY}`.",
    failing="meshes: {main: {key: <removed>}}",
    passing="meshes: {main: {key: {env: MESH_KEY}}}",
)
def key_missing(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.encryption is not Encryption.NONE and mesh.key is None:
            path = ("meshes", mesh.name, "key")
            yield Finding(path, f"{mesh.encryption.value} needs a key", "a reference in `key`", "none")


@fleet_rule(
    "MC403",
    Severity.WARNING,
    "A key is set but the mesh is not encrypted",
    why="The key suggests an encrypted mesh, but the mesh is open.",
    fix="Set `encryption`, or remove the key.",
    failing="meshes: {main: {encryption: none}}",
    passing="meshes: {main: {encryption: psk2+ccmp}}",
)
def key_unused(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.encryption is Encryption.NONE and mesh.key is not None:
            expected = "psk2+ccmp or sae with the key, or no key"
            yield Finding(("meshes", mesh.name, "key"), "the key is not used", expected, "encryption: none")


@fleet_rule(
    "MC404",
    Severity.ERROR,
    "SAE is not available in ad-hoc mode",
    why="The supplicant does not support SAE in ad-hoc cells; the interface does not come up.",
    fix="Use psk2+ccmp, or `mode: mesh`.",
    failing="meshes: {main: {encryption: sae}}",
    passing="meshes: {main: {encryption: sae, mode: mesh}}",
)
def sae_in_adhoc(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mode is MeshMode.ADHOC and mesh.encryption is Encryption.SAE:
            yield Finding(
                ("meshes", mesh.name, "encryption"), "not available in ad-hoc mode", "psk2+ccmp or none", "sae"
            )


@fleet_rule(
    "MC405",
    Severity.ERROR,
    "WPA2 passphrases are not available in 802.11s mode",
    why="802.11s supports SAE only; with psk2 the supplicant starts an open mesh or none.",
    fix="Use `encryption: sae`.",
    failing="meshes: {main: {mode: mesh}}",
    passing="meshes: {main: {mode: mesh, encryption: sae}}",
)
def psk_in_mesh_mode(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.mode is MeshMode.MESH and mesh.encryption is Encryption.PSK2:
            yield Finding(
                ("meshes", mesh.name, "encryption"), "not available in 802.11s mode", "sae or none", "psk2+ccmp"
            )


@fleet_rule(
    "MC406",
    Severity.ERROR,
    "The supplicant cannot encrypt a mesh",
    why="""`wpad-basic*` and `wpad-mini` are built without IBSS_RSN and without encrypted 802.11s: the radio never
    joins.""",
    fix="""Replace it with a full build: `wpad-mesh-mbedtls`, `wpad-openssl` or another `wpad-*` other than basic and
    mini.""",
    failing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-basic-mbedtls]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-mesh-mbedtls]}}",
)
def supplicant_too_small(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node, mesh in _members(fleet):
        need = supplicant_need(mesh, node.release)
        named = (*node.hardware.packages, *node.packages)
        small = [name for name in named if name.startswith(("wpad-basic", "wpad-mini"))]
        if need is None or not small or any(name in FULL_SUPPLICANTS for name in named):
            continue
        path = packages_path(node, small[0])
        yield Finding(path, f"cannot encrypt mesh {mesh.name}", one_of(need.any_of), small[0])


def packages_path(node: Node, package: str) -> tuple[str, ...]:
    """The path that lists `package`: of the node, or of its hardware."""
    if package in node.packages:
        return ("nodes", node.name, "packages", str(node.packages.index(package)))
    if package in node.hardware.packages:
        return ("hardware", node.hardware.name, "packages", str(node.hardware.packages.index(package)))
    return ("hardware", node.hardware.name, "packages")


@fleet_rule(
    "MC407",
    Severity.ERROR,
    "Two supplicants in one image",
    why="The packages contain the same files: the ImageBuilder fails, or the one installed last wins.",
    fix="Keep one of them.",
    failing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, wpad-mbedtls]}}",
    passing="hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl]}}",
)
def two_supplicants(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        named = [name for name in dict.fromkeys((*node.hardware.packages, *node.packages)) if name.startswith("wpad")]
        if len(named) > 1:
            yield Finding(
                packages_path(node, named[1]), f"conflicts with {named[0]}", "one supplicant", join_limited(named)
            )


@fleet_rule(
    "MC408",
    Severity.NOTE,
    "The mesh is open",
    why="""Anyone in range can join the mesh, reach every node's SSH port, and disrupt routing with forged originator
    messages. udp_mesh protects the robots' messages, but not the mesh below it.""",
    fix="""Set `encryption: psk2+ccmp` (ad-hoc, up to 24.10), or `mode: mesh` with `sae`; or suppress this finding with
    a reason.""",
    failing="meshes: {main: {encryption: none, key: <removed>}}",
    passing="meshes: {main: {encryption: psk2+ccmp}}",
)
def mesh_open(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for mesh in fleet.meshes.values():
        if mesh.encryption is Encryption.NONE and mesh.key is None:
            path = ("meshes", mesh.name, "encryption")
            yield Finding(path, "anyone in range can join", "psk2+ccmp, or sae in 802.11s mode", "none")


@fleet_rule(
    "MC409",
    Severity.ERROR,
    "The mesh's passphrase is invalid",
    why="""WPA accepts 8 to 63 printable ASCII characters, or 64 hexadecimal digits; with anything else the supplicant
    rejects its configuration on every node at once. SAE takes 1 to 128 characters; up to OpenWrt 22.03, one of 64, as
    `openssl rand -hex 32` prints, is taken for a raw key, and the supplicant does not join: it has no password.""",
    fix="Generate one: `openssl rand -base64 24`.",
    failing=Example("meshes: {main: {distance_m: 1000}}", environment={"MESH_KEY": "short"}),
    passing=Example("meshes: {main: {distance_m: 1000}}", environment={"MESH_KEY": "cedar-lantern-93-quarry"}),
)
def passphrase_not_allowed(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, value in _passphrases(fleet, context):
        path = ("meshes", mesh.name, "key")
        if mesh.encryption is Encryption.PSK2 and not _is_passphrase(value):
            expected = "8 to 63 printable ASCII characters, or 64 hexadecimal digits"
            yield Finding(path, "invalid passphrase", expected, _length(value))
        elif mesh.encryption is Encryption.SAE and not (1 <= len(value) <= 128 and value.isprintable()):
            yield Finding(path, "invalid passphrase", "1 to 128 characters on one line", _lines(value))
        elif mesh.encryption is Encryption.SAE and len(value.encode()) == 64 and _before_23_05(fleet, mesh):
            message = "up to OpenWrt 22.03, a key of 64 characters joins no SAE mesh"
            found = f"64 characters, and an older release than 23.05 on {join_limited(_before_23_05(fleet, mesh))}"
            yield Finding(path, message, "fewer or more than 64 characters", found)
        elif "'" in value and any(node.release >= Release.V25_12 for node in fleet.members(mesh.name)):
            # same as for an SSID (MC310)
            yield Finding(path, "breaks on OpenWrt 25.12", "no apostrophe", "one")


def _lines(value: str) -> str:
    """What a passphrase of SAE has too much of; a whole file of secrets has several lines."""
    count = len(value.splitlines())
    if count > 1:
        return f"{_length(value)} on {count} lines"
    return _length(value) if value.isprintable() else f"{_length(value)}, some not printable"


def _before_23_05(fleet: Fleet, mesh: Mesh) -> list[str]:
    """The members whose hostapd.sh writes a key of 64 characters as `psk=`, without `sae_password`."""
    return [node.name for node in fleet.members(mesh.name) if node.release < Release.V23_05]


def _passphrases(fleet: Fleet, context: LintContext) -> Iterator[tuple[Mesh, str]]:
    for mesh in fleet.meshes.values():
        secret = context.secret(mesh.key) if mesh.key is not None and mesh.encryption is not Encryption.NONE else None
        if secret is not None:
            yield mesh, secret.reveal()


def _is_passphrase(value: str) -> bool:
    if len(value) == 64:
        return all(letter in "0123456789abcdefABCDEF" for letter in value)
    return 8 <= len(value) <= 63 and value.isascii() and value.isprintable()


@fleet_rule(
    "MC410",
    Severity.WARNING,
    "The mesh's passphrase is short",
    why="""Anyone in range can record the handshake and test millions of guesses per second offline: a passphrase of a
    word and a year lasts minutes.""",
    fix="Generate one of at least 16 characters: `openssl rand -base64 24`.",
    failing=Example("meshes: {main: {distance_m: 1000}}", environment={"MESH_KEY": "husky2021"}),
    passing=Example("meshes: {main: {distance_m: 1000}}", environment={"MESH_KEY": "cedar-lantern-93-quarry"}),
)
def passphrase_short(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for mesh, value in _passphrases(fleet, context):
        # SAE resists offline guessing
        is_tried = mesh.encryption is Encryption.PSK2 and _is_passphrase(value)
        if is_tried and len(value) < _MIN_PASSPHRASE_CHARACTERS:
            expected = f"at least {_MIN_PASSPHRASE_CHARACTERS} characters"
            yield Finding(
                ("meshes", mesh.name, "key"),
                "vulnerable to offline guessing",
                expected,
                _length(value),
            )


def _length(secret: str) -> str:
    return counted(len(secret), "character")
