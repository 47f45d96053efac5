"""Real SSH servers on loopback: dropbear inside a sandbox with busybox ash as login shell, and OpenSSH for old RSA.

Each server runs in mount and process namespaces of its own, so that nothing of the machine's accounts is read or
written and everything it started ends with it.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from meshctl.device.connection import Credentials, Deadlines, Endpoint
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import HostKey, TrustStore, parse_key
from tests.meshctl.device.sandbox import Sandbox
from tests.waiting import until

# Generous on purpose: a busy machine may be slow, and a test passes as soon as the thing is true.
PATIENCE_S = 90.0


def eventually(what: Callable[[], bool], *, patience_s: float = PATIENCE_S) -> None:
    """Poll until `what()` holds."""
    until(what, "it to come true", wait_s=patience_s)


def free_port() -> int:
    """A free port, below the kernel's ephemeral range and distinct for each worker of a parallel run."""
    for port in _PORTS:
        with socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with suppress(OSError):
                sock.bind(("127.0.0.1", port))
                return port
    raise AssertionError("no free port")


def _own_ports() -> Iterator[int]:
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    first = 20_000 + worker % 20 * 500
    # another run on the same machine starts elsewhere in the range
    return ((first + (os.getpid() + n) % 500) for n in itertools.count())


_PORTS = _own_ports()


def listening(port: int) -> bool:
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=5.0):
            return True
    except OSError:
        return False


class Server:
    """A process that listens on `port`; `stop()` ends it and all it started."""

    def __init__(self, argv: list[str], port: int, log: Path, environment: dict[str, str] | None = None) -> None:
        self.port = port
        self._log = log
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                argv, stdout=output, stderr=output, stdin=subprocess.DEVNULL, env=environment
            )
        try:
            eventually(lambda: self._process.poll() is not None or listening(port))
            if self._process.poll() is not None:
                raise AssertionError(f"the server did not start: {log.read_text()}")
        except BaseException:
            self.stop()
            raise

    def endpoint(self, identity: str = "b03") -> Endpoint:
        return Endpoint("127.0.0.1", self.port, identity=identity)

    def stop(self) -> None:
        # unshare --kill-child: the namespace's first process goes with it, and with that one all others
        self._process.kill()
        self._process.wait(timeout=PATIENCE_S)
        # shown with a test that fails: why the server ended a connection
        sys.stderr.write(self._log.read_text(encoding="utf-8", errors="replace"))

    def __enter__(self) -> Server:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def give_dropbear(node: Sandbox, *, key_types: tuple[str, ...] = ("ed25519",), root_password: str = "") -> None:
    """Put dropbear, what it links to and host keys into a sandbox; `root_password` is a crypt(3) string, empty none."""
    program = shutil.which("dropbear", path="/usr/sbin:/usr/bin:/sbin") or "/usr/sbin/dropbear"
    libraries = re.findall(r"(/\S+) \(0x", subprocess.run(["ldd", program], capture_output=True, text=True).stdout)
    for source in [program, *libraries]:
        target = node.path(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(os.path.realpath(source), target)
    node.put("/etc/passwd", "root:x:0:0:root:/root:/bin/sh\n")
    node.put("/etc/shadow", f"root:{root_password}:0:0:99999:7:::\n", 0o600)
    node.put("/etc/group", "root:x:0:\n")
    node.path("/root").mkdir(mode=0o700)
    node.path("/etc/dropbear").mkdir(exist_ok=True)
    for key_type in key_types:
        new_host_key(node, key_type)


def new_host_key(node: Sandbox, key_type: str) -> HostKey:
    """Replace (or make) the node's host key of one type."""
    path = node.path(f"/etc/dropbear/dropbear_{key_type}_host_key")
    path.unlink(missing_ok=True)
    made = subprocess.run(["dropbearkey", "-t", key_type, "-f", path], capture_output=True, text=True, check=True)
    line = next(line for line in made.stdout.splitlines() if line.startswith(("ssh-", "ecdsa-")))
    node.put(f"/etc/dropbear/{key_type}.pub", line)
    return parse_key(line)


def host_key(node: Sandbox, key_type: str = "ed25519") -> HostKey:
    return parse_key(node.text(f"/etc/dropbear/{key_type}.pub") or "")


def authorize(node: Sandbox, *public_keys: Path) -> None:
    """Authorize these keys. OpenWrt reads /etc/dropbear/authorized_keys, Debian's dropbear the home directory's."""
    text = "".join(path.read_text() for path in public_keys)
    node.put("/etc/dropbear/authorized_keys", text, 0o600)
    node.put("/root/.ssh/authorized_keys", text, 0o600)
    node.path("/root/.ssh").chmod(0o700)


ENTER = r"""
root=$1; shift
mount --bind "$root" "$root"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
mount --rbind /sys "$root/sys"
[ -z "$TMP_KIB" ] || mount -t tmpfs -o "size=${TMP_KIB}k" tmpfs "$root/tmp"
mount --bind "$root/harness/boot_id" "$root/proc/sys/kernel/random/boot_id"
cd "$root"
exec chroot "$root" "$@"
"""


def dropbear(node: Sandbox, *options: str, port: int | None = None, tmp_kib: int | None = None) -> Server:
    """Start dropbear in the node as OpenWrt does: three tries (`-T 3`), blank root password let in (`-B`).

    With `tmp_kib` the node has that much RAM for /tmp, and forgets it when the server ends.
    """
    port = port or free_port()
    keys = [
        word
        for path in sorted(node.path("/etc/dropbear").glob("*_host_key"))
        for word in ("-r", f"/etc/dropbear/{path.name}")
    ]
    command = ["/usr/sbin/dropbear", "-F", "-E", "-p", f"127.0.0.1:{port}", "-T", "3", "-B", *keys, *options]
    unshare = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-ec", ENTER, "enter", str(node.root)]
    environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "TMP_KIB": "" if tmp_kib is None else str(tmp_kib)}
    return Server([*unshare, *command], port, node.path("/harness/dropbear.log"), environment)


OPENSSH = r"""
mount -t proc proc /proc
mount --bind "$1/shadow" /etc/shadow
mount --bind "$1/root" /root
mkdir -p /run/sshd
exec /usr/sbin/sshd -D -e -f "$1/sshd_config" -p "$2"
"""


def openssh(directory: Path, authorized: Path, *settings: str, host_key_type: str = "rsa") -> Server:
    """Start OpenSSH's sshd with these extra settings; its account is a `root` whose home is in `directory`."""
    (directory / "root").mkdir(parents=True)
    (directory / "shadow").write_text("root:*:0:0:99999:7:::\n")
    (directory / "shadow").chmod(0o600)
    key = directory / "host_key"
    make_key(key, host_key_type)
    lines = [
        f"HostKey {key}",
        f"AuthorizedKeysFile {authorized}",
        "ListenAddress 127.0.0.1",
        "StrictModes no",
        "UsePAM no",
    ]
    lines += ["PidFile none", "PermitRootLogin yes", *settings]
    (directory / "sshd_config").write_text("".join(f"{line}\n" for line in lines))
    port = free_port()
    unshare = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-ec", OPENSSH, "sshd"]
    return Server([*unshare, str(directory), str(port)], port, directory / "sshd.log")


# No wait of a healthy server comes near these on the busiest machine; tests of deadlines set their own.
PATIENT = Deadlines(connect_s=60, handshake_s=120, auth_s=120, channel_s=120, run_s=120, silence_s=120)


def ready(node: Sandbox, directory: Path) -> Path:
    """Give the node dropbear, a locked password and a new key pair's public part; returns the private file."""
    key = keypair(directory / "operator")
    give_dropbear(node, root_password="!")
    authorize(node, public(key))
    return key


def log_in(server: Server, node: Sandbox, directory: Path) -> SshConnection:
    """A connection with the key of `ready`, trusting the node's present host key."""
    trust = TrustStore(directory / "pins")
    trust.replace("b03", host_key(node))
    ours = Credentials(key_files=(directory / "operator",), use_agent=False)
    return connect(server.endpoint(), credentials=ours, trust=trust, deadlines=PATIENT)


def keypair(path: Path, key_type: str = "ed25519", *, passphrase: str = "") -> Path:
    """A new key pair of OpenSSH's; returns the private file, the public one has `.pub` appended."""
    make_key(path, key_type, passphrase=passphrase)
    return path


def make_key(path: Path, key_type: str, *, passphrase: str = "") -> None:
    # 2048 bits are what dropbear makes; more would only cost time
    size = ["-b", "2048"] if key_type == "rsa" else []
    words = ["ssh-keygen", "-q", "-t", key_type, *size, "-N", passphrase, "-C", path.name, "-f", str(path)]
    subprocess.run(words, check=True)


def public(path: Path) -> Path:
    return path.with_name(path.name + ".pub")
