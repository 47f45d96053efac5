"""Who may log in: operators' keys, host keys, passwords (MC421 to MC433)."""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterator

from meshctl.device.trust import parse_pins
from meshctl.diagnostics import Severity
from meshctl.errors import InputError
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, join_limited
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.identity import known_hosts_path
from meshctl.lint.rules.secrets import logins
from meshctl.lint.sshkey import AuthorizedKey, BadKey, parse_authorized_key
from meshctl.model import Fleet

# NIST SP 800-57 part 1: 2048 bits are the least that is still accepted
_MIN_RSA_BITS = 2048
# keys for examples: whole in form, and nobody's
_ALICE = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f alice"


def _rsa_key(bits: int) -> str:
    fields = (b"ssh-rsa", b"\1\0\1", b"\0" + b"\xc5" * (bits // 8))
    return f"ssh-rsa {base64.b64encode(b''.join(struct.pack('>I', len(part)) + part for part in fields)).decode()}"


RSA_KEY = _rsa_key(2048)


def operator_keys(fleet: Fleet) -> Iterator[tuple[int, AuthorizedKey]]:
    """The operators' keys that can be read, with their places in the list."""
    for index, text in enumerate(fleet.operators.ssh_keys):
        try:
            yield index, parse_authorized_key(text)
        except BadKey:
            continue


@fleet_rule(
    "MC421",
    Severity.ERROR,
    "An operator's key is no public key",
    why="dropbear skips a line it cannot read without a word: after the change its owner is locked out.",
    fix="Copy the whole line of `~/.ssh/id_ed25519.pub`.",
    failing=f"operators: {{ssh_keys: ['{_ALICE}', ssh-ed25519 AAAAC3NzaC1lZDI1NTE5 bob]}}",
    passing=f"operators: {{ssh_keys: ['{_ALICE}']}}",
)
def operator_key_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for index, text in enumerate(fleet.operators.ssh_keys):
        try:
            parse_authorized_key(text)
        except BadKey as reason:
            if "PRIVATE KEY" not in text:
                yield Finding(("operators", "ssh_keys", str(index)), "", "an SSH public key", str(reason))


@fleet_rule(
    "MC422",
    Severity.WARNING,
    "An operator's key is listed twice",
    why="When its owner leaves the team, one line is removed and the other stays.",
    fix="Keep one of the lines.",
    failing=f"operators: {{ssh_keys: ['{_ALICE}', '{_ALICE}@laptop']}}",
    passing=f"operators: {{ssh_keys: ['{_ALICE}']}}",
)
def operator_key_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for _, keys in duplicates((key.text, (index, key)) for index, key in operator_keys(fleet)):
        for index, key in keys[1:]:
            found = key.comment or key.kind
            yield Finding(("operators", "ssh_keys", str(index)), "the same key stands above", "each key once", found)


@fleet_rule(
    "MC423",
    Severity.ERROR,
    "Nobody can log in",
    why="Without a key and without passwords the nodes answer no one: the next change is made with a ladder.",
    fix="Add a public key to `operators.ssh_keys`.",
    failing="operators: {ssh_keys: []}",
    passing=f"operators: {{ssh_keys: ['{_ALICE}']}}",
)
def nobody_can_log_in(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.operators.ssh_keys and not fleet.operators.password_login:
        yield Finding(("operators", "ssh_keys"), "no way to log in", "at least one public key", "none")


@fleet_rule(
    "MC424",
    Severity.WARNING,
    "Nodes take passwords over SSH",
    why="A fresh OpenWrt has an empty password for root; anyone who joins the mesh is root on every radio.",
    fix="Set `operators.password_login: false` and use keys.",
    failing="operators: {password_login: true}",
    passing="operators: {password_login: false}",
)
def password_login(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.operators.password_login:
        yield Finding(("operators", "password_login"), "passwords can be tried by anyone in reach", "false", "true")


@fleet_rule(
    "MC425",
    Severity.ERROR,
    "OpenWrt 19.07 does not know ed25519 keys",
    why="""dropbear of 19.07 has RSA only. With none but ed25519 keys, a node of that release is locked to everybody
    after the change.""",
    fix="Add an RSA key for these nodes, or move them to a newer release.",
    failing=Example(
        """
        nodes: {b01: {release: "19.07"}}
        meshes: {main: {mode: mesh, encryption: sae}}
        """,
        also=("MC311",),
    ),
    passing=Example(
        f"""
        nodes: {{b01: {{release: "19.07"}}}}
        meshes: {{main: {{mode: mesh, encryption: sae}}}}
        operators: {{ssh_keys: ["{_ALICE}", "{RSA_KEY}"]}}
        """,
        also=("MC311",),
    ),
)
def no_rsa_for_19_07(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    old = [node.name for node in fleet.managed() if not node.release.has_ed25519]
    keys = [key for _, key in operator_keys(fleet)]
    if old and keys and not fleet.operators.password_login and not any(key.kind == "ssh-rsa" for key in keys):
        message = f"no key works on nodes with 19.07: {join_limited(old)}"
        yield Finding(("operators", "ssh_keys"), message, "an ssh-rsa key", join_limited([key.kind for key in keys]))


@fleet_rule(
    "MC426",
    Severity.WARNING,
    "An operator's key is weak",
    why="""Current OpenSSH refuses DSA keys, and RSA keys below 2048 bits are no longer held to be safe (NIST SP
    800-57).""",
    fix="Make a new one: `ssh-keygen -t ed25519`.",
    failing=f"operators: {{ssh_keys: ['{_ALICE}', '{_rsa_key(1024)} bob']}}",
    passing=f"operators: {{ssh_keys: ['{_ALICE}']}}",
)
def operator_key_weak(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for index, key in operator_keys(fleet):
        if key.kind == "ssh-dss" or (key.kind == "ssh-rsa" and key.bits < _MIN_RSA_BITS):
            expected = f"ed25519, or RSA of at least {_MIN_RSA_BITS} bits"
            yield Finding(("operators", "ssh_keys", str(index)), "too weak", expected, f"{key.kind}, {key.bits} bits")


@fleet_rule(
    "MC427",
    Severity.ERROR,
    "A pinned host key is no public key",
    why="The node would be refused for ever: what it shows can never match.",
    fix="Run `meshctl trust NODE`.",
    failing="nodes: {b01: {host_keys: [ssh-ed25519 AAAAC3Nza]}}",
    passing="""
    nodes: {b01: {host_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f"]}}
    """,
)
def host_key_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        for index, text in enumerate(node.host_keys):
            try:
                parse_authorized_key(text)
            except BadKey as reason:
                path = ("nodes", node.name, "host_keys", str(index))
                yield Finding(path, "", "an SSH public key", str(reason))


@fleet_rule(
    "MC428",
    Severity.WARNING,
    "A pinned host key is of a kind its release does not have",
    why="19.07's dropbear shows an RSA key only: with an ed25519 key pinned, the node is taken for a stranger.",
    fix="Run `meshctl trust NODE` against the node as it is, or mend its `release`.",
    failing=Example(
        f"""
        operators: {{ssh_keys: ["{_ALICE}", "{RSA_KEY}"]}}
        meshes: {{main: {{mode: mesh, encryption: sae}}}}
        nodes: {{b01: {{release: "19.07", host_keys: ["{_ALICE}"]}}}}
        """,
        also=("MC311",),
    ),
    passing=f"""
    nodes: {{b01: {{host_keys: ["{_ALICE}"]}}}}
    """,
)
def host_key_unknown_to_release(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        kinds = [key.split()[0] for key in node.host_keys if key.split()]
        if kinds and not node.release.has_ed25519 and "ssh-rsa" not in kinds:
            path = ("nodes", node.name, "host_keys")
            yield Finding(path, f"OpenWrt {node.release} has RSA host keys only", "an ssh-rsa key", join_limited(kinds))


@fleet_rule(
    "MC429",
    Severity.WARNING,
    "A radio is logged in to as another user than root",
    why="OpenWrt has no other user that may change anything, and meshctl renders keys for root alone.",
    fix="Take `ssh.user` away.",
    failing="nodes: {b01: {ssh: {user: admin}}}",
    passing="nodes: {b01: {ssh: {user: root}}}",
)
def ssh_user_not_root(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if node.ssh.user != "root":
            yield Finding(("nodes", node.name, "ssh", "user"), "cannot change the node", "root", node.ssh.user)


@fleet_rule(
    "MC430",
    Severity.WARNING,
    "A computer is logged in to as root",
    why="The daemon is installed for the user who logs in; as root a slip of the bundle's scripts has the whole robot.",
    fix="Name the robot's own user in `computer.ssh.user`; it needs sudo for systemd only.",
    failing="robots: {husky1: {computer: {ssh: {user: root}}}}",
    passing="robots: {husky1: {computer: {ssh: {user: robot}}}}",
)
def computer_as_root(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        if robot.computer is not None and robot.computer.ssh.user == "root":
            path = ("robots", robot.name, "computer", "ssh", "user")
            yield Finding(path, "more than is needed", "the robot's own user", "root")


@fleet_rule(
    "MC431",
    Severity.ERROR,
    "The file of pinned host keys cannot be read",
    why="""Every command that logs in stops at its first line that is no pin: nothing can be changed or looked at until
    it is mended.""",
    fix="Mend the line, or remove it and run `meshctl trust` for its node.",
    failing=Example("operators: {known_hosts: known_hosts}", files={"known_hosts": "base ssh-ed25519 AAAA"}),
    passing=Example("operators: {known_hosts: known_hosts}", files={"known_hosts": f"base {_ALICE}"}),
)
def known_hosts_invalid(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    path = known_hosts_path(fleet)
    if context.files.is_special(path):
        yield Finding(("operators", "known_hosts"), "not a regular file", "lines of NAME TYPE BASE64", str(path))
    text = context.files.text(path)
    try:
        parse_pins(text or "", source=fleet.operators.known_hosts)
    except InputError as error:
        yield Finding(("operators", "known_hosts"), str(error), "lines of NAME TYPE BASE64")


@fleet_rule(
    "MC432",
    Severity.NOTE,
    "A computer has no user to log in as",
    why="""Whoever runs meshctl then logs in by their own name, which the robot may not know: what one operator deploys
    the next cannot even look at.""",
    fix="Name the robot's own user in `computer.ssh.user`.",
    failing="robots: {husky1: {computer: {ssh: {user: <removed>}}}}",
    passing="robots: {husky1: {computer: {ssh: {user: robot}}}}",
)
def computer_without_user(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        if robot.computer is not None and not robot.computer.ssh.user:
            path = ("robots", robot.name, "computer", "ssh", "user")
            yield Finding(path, "each operator logs in by their own name", "the robot's own user", "none")


@fleet_rule(
    "MC433",
    Severity.ERROR,
    "A public key is named where a private one is needed",
    why="Logging in takes the private key; the file beside it with `.pub` only proves who has it. Every login fails.",
    fix="Take `.pub` away.",
    failing="nodes: {base: {ssh: {key_files: [id_ed25519.pub]}}}",
    passing=Example("nodes: {base: {ssh: {key_files: [id_ed25519]}}}", files={"id_ed25519": "a private key"}),
)
def public_key_to_log_in(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for place, ssh in logins(fleet):
        for index, file in enumerate(ssh.key_files):
            if file.endswith(".pub"):
                yield Finding((*place, "key_files", str(index)), "a public key", "a private key", file)
