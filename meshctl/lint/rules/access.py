"""Login: operators' keys, host keys, passwords (MC421 to MC435)."""

from __future__ import annotations

import base64
import re
import struct
from collections.abc import Iterator

from meshctl.device.trust import parse_pins
from meshctl.diagnostics import Severity
from meshctl.errors import InputError
from meshctl.inventory.file_paths import file_path, known_hosts_path
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.addresses import is_host
from meshctl.lint.rules.secrets import logins
from meshctl.lint.sshkey import AuthorizedKey, BadKey, parse_authorized_key
from meshctl.model import Fleet
from meshctl.wording import join_limited

# NIST SP 800-57 part 1: 2048 bits are the minimum
_MIN_RSA_BITS = 2048
# a well-formed key for examples, without a known private key
# an IPv6 address needs brackets before a port
_HOST_AND_PORT = re.compile(r"\[(.*)\](?::(\d+))?|([^:]*):(\d+)")
_ALICE = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f alice"


def _rsa_key(bits: int) -> str:
    fields = (b"ssh-rsa", b"\1\0\1", b"\0" + b"\xc5" * (bits // 8))
    return f"ssh-rsa {base64.b64encode(b''.join(struct.pack('>I', len(part)) + part for part in fields)).decode()}"


RSA_KEY = _rsa_key(2048)


def operator_keys(fleet: Fleet) -> Iterator[tuple[int, AuthorizedKey]]:
    """The operators' valid keys, with their list indexes."""
    for index, text in enumerate(fleet.operators.ssh_keys):
        try:
            yield index, parse_authorized_key(text)
        except BadKey:
            continue


@fleet_rule(
    "MC421",
    Severity.ERROR,
    "An operator's key is not a public key",
    why="dropbear silently skips a line that it cannot read: after the change, the key's owner is locked out.",
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
    why="When its owner leaves the team, one line is removed and the other remains.",
    fix="Remove one of the lines.",
    failing=f"operators: {{ssh_keys: ['{_ALICE}', '{_ALICE}@laptop']}}",
    passing=f"operators: {{ssh_keys: ['{_ALICE}']}}",
)
def operator_key_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for _, keys in duplicates((key.text, (index, key)) for index, key in operator_keys(fleet)):
        for index, key in keys[1:]:
            found = key.comment or key.kind
            yield Finding(("operators", "ssh_keys", str(index)), "duplicate of an earlier key", "each key once", found)


@fleet_rule(
    "MC423",
    Severity.ERROR,
    "No operator can log in",
    why="""Without a key and without password login, the nodes cannot be accessed over SSH: the next change needs
    physical access.""",
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
    "Nodes accept passwords over SSH",
    why="A fresh OpenWrt has an empty root password: anyone who joins the mesh becomes root on every radio.",
    fix="Set `operators.password_login: false` and use keys.",
    failing="operators: {password_login: true}",
    passing="operators: {password_login: false}",
)
def password_login(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.operators.password_login:
        yield Finding(("operators", "password_login"), "anyone in range can try passwords", "false", "true")


@fleet_rule(
    "MC425",
    Severity.ERROR,
    "OpenWrt 19.07 does not support ed25519 keys",
    why="""dropbear in 19.07 supports RSA only. If all operator keys are ed25519, no operator can log in to a 19.07 node
    after the change.""",
    fix="Add an RSA key for these nodes, or upgrade them.",
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
        message = f"no operator key works on nodes with 19.07: {join_limited(old)}"
        yield Finding(("operators", "ssh_keys"), message, "an ssh-rsa key", join_limited([key.kind for key in keys]))


@fleet_rule(
    "MC426",
    Severity.WARNING,
    "An operator's key is weak",
    why="""Current OpenSSH rejects DSA keys, and RSA keys below 2048 bits are no longer considered safe (NIST SP
    800-57).""",
    fix="Generate a new key: `ssh-keygen -t ed25519`.",
    failing=f"operators: {{ssh_keys: ['{_ALICE}', '{_rsa_key(1024)} bob']}}",
    passing=f"operators: {{ssh_keys: ['{_ALICE}']}}",
)
def operator_key_weak(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for index, key in operator_keys(fleet):
        if key.kind == "ssh-dss" or (key.kind == "ssh-rsa" and key.bits < _MIN_RSA_BITS):
            expected = f"ed25519, or RSA of at least {_MIN_RSA_BITS} bits"
            yield Finding(
                ("operators", "ssh_keys", str(index)), "key is too weak", expected, f"{key.kind}, {key.bits} bits"
            )


@fleet_rule(
    "MC427",
    Severity.ERROR,
    "A pinned host key is not a public key",
    why="The pinned key can never match the device's key, so the node is always refused.",
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
    "The release does not support the pinned host key's type",
    why="dropbear in 19.07 has an RSA host key only: with an ed25519 key pinned, host key verification always fails.",
    fix="Run `meshctl trust NODE` on the node as it is, or correct its `release`.",
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
            yield Finding(
                path, f"OpenWrt {node.release} supports RSA host keys only", "an ssh-rsa key", join_limited(kinds)
            )


@fleet_rule(
    "MC429",
    Severity.WARNING,
    "A radio's SSH user is not root",
    why="OpenWrt has no other user that may change the configuration, and meshctl renders keys for root only.",
    fix="Remove `ssh.user`.",
    failing="nodes: {b01: {ssh: {user: admin}}}",
    passing="nodes: {b01: {ssh: {user: root}}}",
)
def ssh_user_not_root(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if node.ssh.user != "root":
            yield Finding(
                ("nodes", node.name, "ssh", "user"),
                "this user cannot change the node's configuration",
                "root",
                node.ssh.user,
            )


@fleet_rule(
    "MC430",
    Severity.WARNING,
    "A computer's SSH user is root",
    why="""The daemon is installed for the login user; as root, an error in the bundle's scripts affects the whole
    robot.""",
    fix="Set `computer.ssh.user` to the robot's own user; it needs sudo for systemd only.",
    failing="robots: {husky1: {computer: {ssh: {user: root}}}}",
    passing="robots: {husky1: {computer: {ssh: {user: robot}}}}",
)
def computer_as_root(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        if robot.computer is not None and robot.computer.ssh.user == "root":
            path = ("robots", robot.name, "computer", "ssh", "user")
            yield Finding(path, "more privileges than needed", "the robot's own user", "root")


@fleet_rule(
    "MC431",
    Severity.ERROR,
    "The file of pinned host keys is invalid",
    why="""Every command that logs in stops at the first invalid line: no node can be changed or inspected until it is
    fixed.""",
    fix="Fix the line, or remove it and run `meshctl trust` for its node.",
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
    "A computer has no SSH user",
    why="""Each operator then logs in with their own user name, which the robot may not have: what one operator deploys,
    the next cannot access.""",
    fix="Set `computer.ssh.user` to the robot's own user.",
    failing="robots: {husky1: {computer: {ssh: {user: <removed>}}}}",
    passing="robots: {husky1: {computer: {ssh: {user: robot}}}}",
)
def computer_without_user(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        if robot.computer is not None and not robot.computer.ssh.user:
            path = ("robots", robot.name, "computer", "ssh", "user")
            yield Finding(path, "each operator logs in with their own user name", "the robot's own user", "none")


@fleet_rule(
    "MC433",
    Severity.ERROR,
    "A public key is listed where a private key is needed",
    why="Login needs the private key; with the public key every login fails.",
    fix="Name the private key: the file without `.pub`.",
    failing="nodes: {base: {ssh: {key_files: [id_ed25519.pub]}}}",
    passing=Example("nodes: {base: {ssh: {key_files: [id_ed25519]}}}", files={"id_ed25519": "a private key"}),
)
def public_key_to_log_in(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for place, ssh in logins(fleet):
        for index, file in enumerate(ssh.key_files):
            if file.endswith(".pub") or _is_public_key(context.files.text(file_path(fleet, file)) or ""):
                yield Finding((*place, "key_files", str(index)), "login needs the private key", "a private key", file)


@fleet_rule(
    "MC434",
    Severity.ERROR,
    "An SSH host contains the user or the port, or a user the host",
    why="""`ssh.host` is a name or an address alone, and `ssh.user` a user's name: with both in one of them, no login
    reaches the device.""",
    fix="Write them under their own keys: `ssh: {host: gw.example, port: 2222, user: mesh}`.",
    failing="robots: {husky1: {computer: {ssh: {host: 'robot@10.42.0.110:2222'}}}}",
    passing="robots: {husky1: {computer: {ssh: {host: 10.42.0.110, port: 2222}}}}",
)
def host_with_user_or_port(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for place, ssh in logins(fleet):
        user, _, rest = ssh.host.rpartition("://")[2].rpartition("@")
        found = _HOST_AND_PORT.fullmatch(rest)
        bracketed, port, host, other_port = found.groups(default="") if found else ("", "", rest, "")
        if (bracketed or host) != ssh.host:
            parts = {"host": bracketed or host, "port": port or other_port, "user": user}
            expected = ", ".join(f"{key}: {value}" for key, value in parts.items() if value)
            yield Finding((*place, "host"), "not a host name or address alone", expected, ssh.host)
        user, at, host = ssh.user.rpartition("@")
        if at:
            yield Finding((*place, "user"), "not a user's name alone", f"user: {user}, host: {host}", ssh.user)


@fleet_rule(
    "MC435",
    Severity.ERROR,
    "An SSH host is neither an address nor a host name",
    why="No name server knows such a name, so no login reaches the device.",
    fix="Write the name or the address alone, without blanks, underscores or quotes.",
    failing="robots: {husky1: {computer: {ssh: {host: husky 1}}}}",
    passing="robots: {husky1: {computer: {ssh: {host: husky-1}}}}",
    is_fallback=True,
)
def not_an_ssh_host(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for place, ssh in logins(fleet):
        # an IPv6 address may have a zone here
        if ssh.host and not is_host(ssh.host.partition("%")[0]):
            yield Finding((*place, "host"), "not a host", "an address such as 10.42.0.110, or a host name", ssh.host)


def _is_public_key(text: str) -> bool:
    try:
        parse_authorized_key(text.strip())
    except BadKey:
        return False
    return True
