"""Secrets: not in the inventory or the repository, and strong enough (MC441 to MC454)."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator
from itertools import pairwise
from pathlib import Path

from meshctl.diagnostics import Position, Severity
from meshctl.inventory.file_paths import file_path
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates
from meshctl.lint.rule import Example, Finding, fleet_rule, text_rule
from meshctl.model import Fleet, Secret, SecretKind, SecretRef, SshSettings
from meshctl.render.daemon import key_bytes, key_text
from meshctl.uci import is_secret_option
from meshctl.wording import counted

# as in udp_mesh/crypto/keys.py
_KEY_BYTES = 32
_SAFE_MODE_MASK = 0o077
_MIN_DISTINCT_BYTES = 16
_TRANSPORT_KEY = "b4f8e7f0c3a94c21a1d2d9a0f5c36e7722d1b6c8e3f04a5b9c7d8e1f2a3b4c5d"

_KEY_MATERIAL = (
    (re.compile(r"-----BEGIN [A-Z0-9 ]*PRIVATE KEY-----"), "a private key"),
    (re.compile(r"AGE-SECRET-KEY-1[0-9A-Z]{20,}"), "an age identity"),
    (re.compile(r"untrusted comment: (?:OpenWrt )?(?:secret|private) key", re.IGNORECASE), "a usign secret key"),
    # a 32-byte key in place of a reference
    (re.compile(r"(?i)\bkeys?\b[\"']?\s*:\s*\[?\s*[\"']?(?:[0-9a-f]{64}\b|[a-z0-9+/]{43}=)"), "a key"),
    # a key in place of the variable's name
    (re.compile(r"\benv[\"']?\s*:\s*[\"']?(?=[a-f_]*[0-9])(?:[0-9a-f]{16,}|[0-9A-F]{16,})\b"), "a key"),
    # a value after a telling name
    (
        re.compile(
            r"(?i)\b(?:psk|passphrase|password|passwd|secret|wpa_key|mesh_key|udp_mesh_key)\b[\"']?\s*[:=]\s*[\"']?[^\s\"'{}\[\],#]{8,}"
        ),
        "what looks like a secret",
    ),
)


def secret_refs(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], SecretRef]]:
    """Every secret reference with its path."""
    for mesh in fleet.meshes.values():
        if mesh.key is not None:
            yield ("meshes", mesh.name, "key"), mesh.key
    yield from transport_keys(fleet)


def transport_keys(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], SecretRef]]:
    """The keys of the daemons: the fleet's, and those of the relays' hops."""
    for name, keys in (("keys", fleet.udp_mesh.keys), ("relay_keys", fleet.udp_mesh.relay_keys)):
        for index, key in enumerate(keys):
            yield ("udp_mesh", name, str(index)), key


def _secret_files(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], Path, str]]:
    """Files with plaintext secrets: secret files, age identities, private SSH keys."""
    for path, ref in secret_refs(fleet):
        match ref.kind:
            case SecretKind.FILE:
                yield (*path, "file"), file_path(fleet, ref.where, ref.base), "the secret"
            case SecretKind.AGE if ref.identity:
                yield (*path, "identity"), file_path(fleet, ref.identity, ref.base), "the age identity"
            case SecretKind.AGE | SecretKind.ENV:
                pass
    # nodes of a group share one list: report each file once
    seen: set[str] = set()
    for place, ssh in logins(fleet):
        for index, file in enumerate(ssh.key_files):
            if file not in seen and not file.endswith(".pub"):
                seen.add(file)
                yield (*place, "key_files", str(index)), file_path(fleet, file), "the private key"


def logins(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], SshSettings]]:
    """The SSH settings of every node, computer and site, with their paths."""
    for node in fleet.nodes.values():
        yield ("nodes", node.name, "ssh"), node.ssh
    for robot in fleet.robots.values():
        for place, _, computer in robot.all_computers():
            yield ("robots", robot.name, *place, "ssh"), computer.ssh
    for site in fleet.sites.values():
        yield ("sites", site.name, "ssh"), site.ssh


@text_rule(
    "MC441",
    Severity.ERROR,
    "The inventory contains key material",
    why="""The inventory is kept in git, copied to laptops and pasted into chats: a key that was ever in it is public,
    even after its removal.""",
    fix="Replace it with a reference (`{env: NAME}`, `{file: ...}` or `{age: ...}`), and generate a new key.",
    failing="system: {log_host: 10.42.0.100}  # psk: 5f4dcc3b5aa765d61d8327deb882cf99",
    passing="system: {log_host: 10.42.0.100}  # the key is in the vault",
)
def key_material(file: str, text: str) -> Iterator[Finding]:
    for number, line in enumerate(text.splitlines(), 1):
        for pattern, what in _KEY_MATERIAL:
            match = pattern.search(line)
            if match is not None:
                place = Position(file, number, match.start() + 1)
                yield Finding((), f"the file contains {what}", "a reference", position=place)
                break


@fleet_rule(
    "MC442",
    Severity.ERROR,
    "A secret file is readable by others",
    why="Every user and every program on the operator's machine can read the fleet's key.",
    fix="Run `chmod 600` on the file.",
    failing=Example(
        "udp_mesh: {keys: [{file: mode-0644.key}]}",
        files={"mode-0644.key": _TRANSPORT_KEY},
    ),
    passing=Example(
        "udp_mesh: {keys: [{file: mode-0600.key}]}",
        files={"mode-0600.key": _TRANSPORT_KEY},
    ),
)
def secret_readable(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, path, what in _secret_files(fleet):
        mode = context.files.mode(path)
        if mode is not None and mode & _SAFE_MODE_MASK:
            yield Finding(place, f"others can read {what}", "mode 0600", f"{path} with mode {mode:04o}")


@fleet_rule(
    "MC443",
    Severity.ERROR,
    "A secret file is inside the repository",
    why="The next `git add .` publishes it.",
    fix="Move it out of the repository, list it in .gitignore, or encrypt it with age.",
    failing=Example(
        "udp_mesh: {keys: [{file: fleet.key}]}",
        files={".git/HEAD": "ref: refs/heads/main", "fleet.key": _TRANSPORT_KEY},
    ),
    passing=Example(
        "udp_mesh: {keys: [{file: fleet.key}]}",
        files={"fleet.key": _TRANSPORT_KEY},
    ),
)
def secret_in_repository(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, path, what in _secret_files(fleet):
        if context.files.mode(path) is not None and context.files.in_repository(path):
            yield Finding(place, f"{what} would be committed", "a place outside the repository", str(path))


@fleet_rule(
    "MC444",
    Severity.ERROR,
    "An age file that a secret refers to is missing",
    why="An encrypted file belongs next to the inventory. Without it, rendering fails.",
    fix="Commit the file, or correct the path, which is relative to the file that names it.",
    failing="udp_mesh: {keys: [{age: absent.age, key: udp_mesh}]}",
    passing="udp_mesh: {keys: [{env: UDP_MESH_KEY}]}",
)
def secret_file_missing(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, ref in secret_refs(fleet):
        if ref.kind is SecretKind.AGE and context.files.mode(file_path(fleet, ref.where, ref.base)) is None:
            yield Finding((*place, "age"), "no such file", "a file encrypted with age", ref.where)


@fleet_rule(
    "MC445",
    Severity.ERROR,
    "The transport key is invalid",
    why="""udp_mesh requires 32 random bytes, as 64 hexadecimal digits or base64, and refuses to start with anything
    else. A word or a short key could be guessed offline from a few seconds of recorded traffic.""",
    fix="Generate one: `udp-mesh keygen FILE` or `openssl rand -hex 32`.",
    failing=Example("udp_mesh: {port: 8700}", environment={"UDP_MESH_KEY": "husky2021"}),
    # as `udp-mesh keygen` writes it, followed by the key id
    passing=Example(
        "udp_mesh: {keys: [{file: mode-0600.key}]}", files={"mode-0600.key": f"{_TRANSPORT_KEY}  # 5d3c1a90\n"}
    ),
)
def transport_key_invalid(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for path, ref in transport_keys(fleet):
        secret = context.secret(ref)
        if secret is not None and key_bytes(key_text(secret)) is None:
            expected = f"{_KEY_BYTES} bytes: {2 * _KEY_BYTES} hexadecimal digits, or base64"
            found = counted(len(key_text(secret)), "character")
            yield Finding(path, "invalid key", expected, found)


@fleet_rule(
    "MC446",
    Severity.ERROR,
    "The transport has no key",
    why="Without a fleet key, anyone in range can send or release an emergency stop.",
    fix="Reference the key: `udp_mesh: {keys: [{env: UDP_MESH_KEY}]}`.",
    failing="udp_mesh: {keys: []}",
    passing="udp_mesh: {keys: [{env: UDP_MESH_KEY}]}",
)
def transport_key_missing(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    computers = any(robot.computer is not None for robot in fleet.robots.values())
    if computers and fleet.topics and not fleet.udp_mesh.keys:
        yield Finding(("udp_mesh", "keys"), "messages would be unprotected", "a reference in `keys`", "none")


@fleet_rule(
    "MC447",
    Severity.WARNING,
    "One secret is used for two purposes",
    why="""The Wi-Fi passphrase is in the flash of every radio, including lost beacons. If it is also the transport key,
    a lost beacon exposes both.""",
    fix="Use a separate secret for each.",
    failing=Example("udp_mesh: {keys: [{env: MESH_KEY}]}", environment={"MESH_KEY": _TRANSPORT_KEY}),
    passing="udp_mesh: {keys: [{env: UDP_MESH_KEY}]}",
)
def secret_shared(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    mesh_keys = {identity(context, ref): place for place, ref in secret_refs(fleet) if place[0] == "meshes"}
    for path, ref in transport_keys(fleet):
        place = mesh_keys.get(identity(context, ref))
        if place is not None:
            message = f"also the key of {place[0]}.{place[1]}"
            yield Finding(path, message, "a separate secret", str(ref))


def identity(context: LintContext, ref: SecretRef) -> Hashable:
    """Equal for two references to one secret: its value if available, else its location."""
    secret = context.secret(ref)
    return (ref.kind, ref.where, ref.key) if secret is None else Secret(key_text(secret))


@fleet_rule(
    "MC448",
    Severity.WARNING,
    "A transport key is listed twice",
    why="Two live keys exist for key rotation: the new one and the old one. A duplicate rotates nothing.",
    fix="List the new key first and the old one second; remove the old one when all robots have the new key.",
    failing="udp_mesh: {keys: [{env: UDP_MESH_KEY}, {env: UDP_MESH_KEY}]}",
    passing="udp_mesh: {keys: [{env: UDP_MESH_KEY}, {env: UDP_MESH_OLD_KEY}]}",
)
def transport_key_twice(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    marks = ((identity(context, ref), index) for index, ref in enumerate(fleet.udp_mesh.keys))
    for _, indexes in duplicates(marks):
        for index in indexes[1:]:
            found = str(fleet.udp_mesh.keys[index])
            yield Finding(("udp_mesh", "keys", str(index)), "duplicate of an earlier key", "another key", found)


@fleet_rule(
    "MC449",
    Severity.ERROR,
    "More than two transport keys are live",
    why="""udp_mesh holds two keys: the current one and the previous one. A third is never tried, and robots that still
    use it are cut off.""",
    fix="Finish the key rotation: keep the new key and at most one old key.",
    failing="udp_mesh: {keys: [{env: UDP_MESH_KEY}, {env: SECOND}, {env: THIRD}]}",
    passing="udp_mesh: {keys: [{env: UDP_MESH_KEY}, {env: SECOND}]}",
)
def too_many_transport_keys(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if len(fleet.udp_mesh.keys) > 2:
        found = str(len(fleet.udp_mesh.keys))
        yield Finding(("udp_mesh", "keys", "2"), "never tried", "at most two keys", found)


@fleet_rule(
    "MC450",
    Severity.ERROR,
    "A secret file lacks the secret",
    why="The file exists but does not contain the referenced entry: rendering and provisioning fail at this reference.",
    fix="Correct `key`, or add the entry to the file.",
    failing=Example(
        "udp_mesh: {keys: [{file: mode-0600.yaml, key: udp-mesh}]}",
        files={"mode-0600.yaml": f"udp_mesh: {_TRANSPORT_KEY}\n"},
    ),
    passing=Example(
        "udp_mesh: {keys: [{file: mode-0600.yaml, key: udp_mesh}]}",
        files={"mode-0600.yaml": f"udp_mesh: {_TRANSPORT_KEY}\n"},
    ),
)
def secret_absent(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, ref in secret_refs(fleet):
        path = file_path(fleet, ref.where, ref.base)
        is_here = ref.kind is not SecretKind.ENV and (
            context.files.mode(path) is not None or context.files.is_special(path)
        )
        problem = context.secret_problem(ref) if is_here else ""
        if problem:
            key = "key" if ref.key else ref.kind.value
            yield Finding(
                (*place, key), "no secret found", f"a text under `{ref.key}`" if ref.key else "a text", problem
            )


@fleet_rule(
    "MC451",
    Severity.WARNING,
    "The environment variable of a secret is empty",
    why="""The variable is set to an empty string: a misspelled name on the right of `export`, or a CI job without
    access to its secrets. Rendering refuses it like an unset variable.""",
    fix="Export the secret, or unset the variable where secrets are not needed.",
    failing=Example("udp_mesh: {port: 8700}", environment={"UDP_MESH_KEY": ""}),
    passing=Example("udp_mesh: {port: 8700}", environment={"UDP_MESH_KEY": _TRANSPORT_KEY}),
)
def variable_empty(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, ref in secret_refs(fleet):
        if ref.kind is SecretKind.ENV and context.secret_problem(ref):
            yield Finding((*place, "env"), "set but empty", "the secret", f"{ref.where}=")


@fleet_rule(
    "MC452",
    Severity.NOTE,
    "A key file is not on this machine",
    why="CI does not need the keys. The operator's laptop does: without the file, rendering or login fails.",
    fix="Copy the file to this machine, or correct the path, which is relative to the file that names it.",
    failing="nodes: {base: {ssh: {key_files: [absent_ed25519]}}}",
    passing=Example("nodes: {base: {ssh: {key_files: [id_ed25519]}}}", files={"id_ed25519": "a private key"}),
)
def key_file_missing(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, path, what in _secret_files(fleet):
        if context.files.mode(path) is None and not context.files.is_special(path):
            yield Finding(place, f"{what} is missing", "a file", str(path))


@fleet_rule(
    "MC453",
    Severity.ERROR,
    "The transport key is guessable",
    why="""32 zero bytes, a repeated byte or a counting sequence are among the first keys that an attacker tries; with
    the key, anyone can stop every robot.""",
    fix="Generate one: `udp-mesh keygen FILE` or `openssl rand -hex 32`.",
    failing=Example("udp_mesh: {port: 8700}", environment={"UDP_MESH_KEY": "0" * 64}),
    passing=Example("udp_mesh: {port: 8700}", environment={"UDP_MESH_KEY": _TRANSPORT_KEY}),
)
def transport_key_guessable(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for path, ref in transport_keys(fleet):
        secret = context.secret(ref)
        raw = None if secret is None else key_bytes(key_text(secret))
        if raw is not None and _is_pattern(raw):
            yield Finding(path, "not random", "32 random bytes", "a pattern")


def _is_pattern(raw: bytes) -> bool:
    """Few distinct bytes (32 random bytes have about 30, in practice never below 16), or an arithmetic sequence."""
    distances = {(second - first) % 256 for first, second in pairwise(raw)}
    return len(set(raw)) < _MIN_DISTINCT_BYTES or len(distances) == 1


@fleet_rule(
    "MC454",
    Severity.ERROR,
    "An extra UCI option is a secret",
    why="""`extra_uci` has its values in plain text: the key or password is in the inventory, in git and in every copy,
    and so public, even after its removal.""",
    fix="""Remove it, and generate a new key. A mesh's key belongs into `key` of the mesh, as a reference; other secrets
    cannot be in `extra_uci`.""",
    failing="nodes: {b01: {extra_uci: {wireless.mesh0.sae_password: 'correct horse battery'}}}",
    passing="nodes: {b01: {extra_uci: {wireless.mesh0.mesh_rssi_threshold: '-80'}}}",
)
def secret_extra_uci(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        for key, value in node.extra_uci.items():
            if value and key.count(".") > 1 and is_secret_option(key.rpartition(".")[2]):
                path = ("nodes", node.name, "extra_uci", key)
                yield Finding(path, "the inventory contains a secret", "an option that is not secret", key)
