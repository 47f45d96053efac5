"""Refuse values that a node's files cannot contain, or that would lock the operator out.

Lint checks whether a configuration is sensible; this module only checks whether the node would read it as intended. UCI
can hold any text, but its consumers (netifd's shell scripts, wpa_supplicant's file) cannot.
"""

from __future__ import annotations

import re

from meshctl.diagnostics import Diagnostic, Position, Severity
from meshctl.model import Backend, Encryption, Fleet, Mesh, MeshMode, MissingOrigin, Release, Secret
from meshctl.wording import counted

# Codes of this module, described in docs/render.md.
VALUE = "RND001"
COMBINATION = "RND002"
LOCKED_OUT = "RND003"
RECONNECT = "RND004"
SECRET = "RND005"

_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_HOSTNAME = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(?<!-)")
# a package is named like its file; a section may be `@TYPE[INDEX]`
_UCI_KEY = re.compile(r"[A-Za-z0-9_-]+\.([A-Za-z0-9_]+|@[A-Za-z0-9_-]+\[\d+\])(\.[A-Za-z0-9_]+)?")
_WORD = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_+-]*")
_SECTION = re.compile(r"[A-Za-z0-9_]+")
_MAC = re.compile(r"[0-9A-Fa-f]{2}(:[0-9A-Fa-f]{2}){5}")
# IFNAMSIZ is 16 with the terminator; 19.07 joins a bridge's ports with spaces
_DEVICE = re.compile(r"[^\s/:'\"\\\x00-\x1f]{1,15}")
_PUBLIC_KEY = re.compile(
    r"(ssh-(?:rsa|ed25519)|ecdsa-sha2-nistp(?:256|384|521)|sk-[a-z0-9@.-]+) [A-Za-z0-9+/]+={0,3}( .*)?"
)
_RAW_PSK = re.compile(r"[0-9A-Fa-f]{64}")
_PASSPHRASE = re.compile(r"[ -~]{8,63}")
# 802.11: an SSID has at most 32 bytes
_MAX_SSID_BYTES = 32
# limit of hostapd and wpa_supplicant for one line of their configuration
_MAX_SAE_CHARACTERS = 128


class ValueChecks:
    """Collects diagnostics of invalid values in `found`."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self.found: list[Diagnostic] = []

    def position(self, *path: str) -> Position:
        """The position of a value, or else the inventory's first file."""
        try:
            return self._fleet.where(*path).position
        except MissingOrigin:
            return Position(self._fleet.files[0] if self._fleet.files else self._fleet.name)

    def add(
        self, code: str, path: tuple[str, ...], expected: str, found: str, *, message: str = "", hint: str = ""
    ) -> None:
        """Report a value at `path`."""
        self.found.append(
            Diagnostic(code, Severity.ERROR, self.position(*path), message, ".".join(path), expected, found, hint)
        )

    def text(self, path: tuple[str, ...], value: str, *, is_required: bool = False) -> None:
        """Text on one line."""
        if _CONTROL.search(value):
            self.add(VALUE, path, "text without line breaks or control characters", repr(value))
        if is_required and not value:
            self.add(VALUE, path, "a value", "none")

    def uci_key(self, path: tuple[str, ...], value: str) -> None:
        """The full name of a UCI section or option."""
        if not _UCI_KEY.fullmatch(value):
            self.add(VALUE, path, "PACKAGE.SECTION.OPTION or PACKAGE.SECTION", repr(value))

    def word(self, path: tuple[str, ...], value: str) -> None:
        """A word that the node's scripts use unquoted in commands."""
        if not _WORD.fullmatch(value):
            self.add(VALUE, path, "a word of letters, digits, _, + and -", repr(value))

    def section(self, path: tuple[str, ...], value: str) -> None:
        """The name of a UCI section."""
        if not _SECTION.fullmatch(value):
            self.add(VALUE, path, "a UCI section's name of letters, digits and _", repr(value))

    def hostname(self, path: tuple[str, ...], value: str) -> None:
        """A hostname by RFC 1123, without dots."""
        if not _HOSTNAME.fullmatch(value):
            self.add(VALUE, path, "a hostname of at most 63 letters, digits and inner hyphens", repr(value))

    def device(self, path: tuple[str, ...], value: str) -> None:
        """The name of a network device."""
        if not _DEVICE.fullmatch(value):
            self.add(VALUE, path, "a network device's name of at most 15 characters", repr(value))

    def tx_power(self, path: tuple[str, ...], value: int, release: Release) -> None:
        """A drive level that the radio's scripts do not treat as unset."""
        if release >= Release.V25_12 and value == 0:
            message = f"OpenWrt {release} treats 0 as unset and transmits at full power"
            self.add(VALUE, path, "at least 1", "0", message=message)

    def mesh(self, mesh: Mesh, release: Release) -> None:
        """A mesh's SSID and BSSID, and whether this release can join it."""
        path = ("meshes", mesh.name)
        self._ssid((*path, "ssid"), mesh.ssid, release)
        self.word((*path, "htmode"), mesh.htmode)
        if mesh.backend is Backend.BATMAN:
            self.word((*path, "batman", "routing_algo"), mesh.batman.routing_algo)
            self.word((*path, "batman", "gw_mode"), mesh.batman.gw_mode)
        if mesh.mode is MeshMode.ADHOC and not _MAC.fullmatch(mesh.bssid):
            self.add(VALUE, (*path, "bssid"), "six pairs of hex digits, as in 02:ca:fe:00:00:01", repr(mesh.bssid))
        match (mesh.mode, mesh.encryption):
            case (MeshMode.ADHOC, Encryption.SAE):
                self.add(COMBINATION, (*path, "encryption"), "none or psk2+ccmp in ad-hoc mode", "sae")
            case (MeshMode.MESH, Encryption.PSK2):
                self.add(COMBINATION, (*path, "encryption"), "none or sae in 802.11s mode", "psk2+ccmp")
            case (MeshMode.ADHOC, Encryption.PSK2) if release >= Release.V25_12:
                hint = "use mode: mesh with encryption: sae, or an earlier release"
                message = f"OpenWrt {release} silently joins an encrypted ad-hoc cell without encryption"
                self.add(COMBINATION, (*path, "encryption"), "none", "psk2+ccmp", message=message, hint=hint)
            case _:
                pass
        if mesh.encryption is not Encryption.NONE and mesh.key is None:
            self.add(COMBINATION, (*path, "key"), f"a reference to the key of {mesh.encryption.value}", "none")

    def _ssid(self, path: tuple[str, ...], ssid: str, release: Release) -> None:
        size = len(ssid.encode("utf-8", "surrogatepass"))
        if not 1 <= size <= _MAX_SSID_BYTES:
            self.add(VALUE, path, f"1 to {_MAX_SSID_BYTES} bytes", f"{size} bytes in {ssid!r}")
        self.text(path, ssid)
        if release >= Release.V25_12 and "'" in ssid:
            self.add(VALUE, path, f"no single quote (OpenWrt {release} passes it to a shell)", repr(ssid))

    def key(self, mesh: Mesh, key: Secret, release: Release) -> None:
        """A mesh's key by the rules of its encryption; diagnostics never show it."""
        path = ("meshes", mesh.name, "key")
        value = key.reveal()
        if mesh.encryption is Encryption.PSK2:
            if not _PASSPHRASE.fullmatch(value) and not _RAW_PSK.fullmatch(value):
                self.add(VALUE, path, "8 to 63 printable ASCII characters or 64 hex digits", _describe_secret(value))
        elif not 1 <= len(value) <= _MAX_SAE_CHARACTERS or _CONTROL.search(value):
            self.add(VALUE, path, f"1 to {_MAX_SAE_CHARACTERS} characters without line breaks", _describe_secret(value))
        if release >= Release.V25_12 and "'" in value:
            self.add(VALUE, path, f"no single quote (OpenWrt {release} passes it to a shell)", _describe_secret(value))

    def collector(self, robot: str, key: str) -> None:
        """The public key of a robot's collector."""
        if _PUBLIC_KEY.fullmatch(key) is None or _CONTROL.search(key):
            path = ("robots", robot, "computer", "collector_key")
            self.add(VALUE, path, "one OpenSSH public key on one line", repr(key))

    def login(self, keys: tuple[str, ...], *, is_password_allowed: bool, release: Release) -> None:
        """Public keys on one line each, at least one of which this release's dropbear supports."""
        usable = 0
        for index, key in enumerate(keys):
            found = _PUBLIC_KEY.fullmatch(key)
            if found is None or _CONTROL.search(key):
                self.add(VALUE, ("operators", "ssh_keys", str(index)), "one OpenSSH public key on one line", repr(key))
            elif release.has_ed25519 or found[1] == "ssh-rsa":
                usable += 1
        if usable == 0 and not is_password_allowed:
            kinds = (
                "an OpenSSH public key"
                if release.has_ed25519
                else f"an RSA key, the only type that OpenWrt {release} supports"
            )
            message = "no operator could log in to the node"
            path = ("operators", "ssh_keys")
            self.add(LOCKED_OUT, path, kinds, "none", message=message, hint="add a key to operators.ssh_keys")


def _describe_secret(secret: str) -> str:
    """A description of a secret for messages: length and character set only."""
    plain = "" if secret.isascii() and secret.isprintable() else ", some not printable ASCII"
    return f"{counted(len(secret), 'character')}{plain}"
