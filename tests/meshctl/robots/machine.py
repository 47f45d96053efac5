"""Robot computers for tests: a real OpenSSH server whose sessions live in a root of their own.

Each machine is a mount and process namespace with private /etc, /opt, /root, /run and /var/lib on a loopback address of
its own; nothing of the machine the tests run on is written. Its `systemctl` is the stand-in of stand_in_systemctl.py,
because pid 1 is no systemd here; the daemon under it is the real one, run by the real interpreter at /opt/python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from meshctl.device.connection import Credentials, Deadlines, Endpoint
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import HostKey, TrustStore, parse_key
from tests.meshctl.device.servers import PATIENCE_S, Server, eventually

PYTHON = f"/opt/python/bin/python{sys.version_info.major}.{sys.version_info.minor}"
PATIENT = Deadlines(connect_s=60, handshake_s=120, auth_s=120, channel_s=120, run_s=120)

# Enough of /etc for sshd, useradd and the dynamic linker.
_ETC = ("passwd", "group", "nsswitch.conf", "ld.so.cache", "ld.so.conf", "ld.so.conf.d", "login.defs", "alternatives")

_ENTER = r"""
mount --make-rprivate /
mkdir -p "$1/opt/python" "$1/var" "$1/root" "$1/etc/systemd/system"
[ -z "$OPT_KIB" ] || { mount -t tmpfs -o "size=${OPT_KIB}k" tmpfs "$1/opt"; mkdir -p "$1/opt/python"; }
mount --bind "$PREFIX" "$1/opt/python"
mount --rbind "$1/opt" /opt
[ -z "$OVERLAY" ] || mount -t overlay overlay -o "lowerdir=$OVERLAY:/usr" /usr
mount --bind "$1/etc" /etc
mount --bind "$1/var" /var/lib
mount --bind "$1/root" /root
mount -t tmpfs tmpfs /run
mkdir -p /run/sshd /run/systemd/system
# no test cuts the power of the disk, and a real sync waits for whatever else this computer writes
mount --bind /bin/true /bin/sync
exec /usr/sbin/sshd -D -e -f "$1/sshd_config" -p "$2"
"""


class Machine:
    """One computer. `address` is its own; `root` is where its private directories are, seen from outside."""

    def __init__(self, root: Path, address: str, port: int, key: Path, *, opt_kib: int | None = None) -> None:
        self.root = root
        self.address = address
        self.port = port
        self._key = key
        self._opt_kib = opt_kib
        self.overlay: Path | None = None
        """A directory that lies over /usr, with what this computer has more."""
        self._server: Server | None = None
        for name in ("etc", "bin"):
            (root / name).mkdir(parents=True)
        for name in _ETC:
            source = Path("/etc", name)
            if source.is_dir():
                shutil.copytree(source, root / "etc" / name, symlinks=True)
            elif source.exists():
                shutil.copy2(source, root / "etc" / name)
        # where every user of this computer may read it
        shutil.copy(f"{key}.pub", root / "etc/operator.pub")
        (root / "etc/shadow").write_text("root:*:0:0:99999:7:::\n")
        (root / "etc/shadow").chmod(0o600)
        stand_in = Path(__file__).with_name("stand_in_systemctl.py").read_text()
        self.tool("systemctl", f"#!{PYTHON}\n{stand_in}")
        self.tool(
            "journalctl", '#!/bin/sh\nwhile [ "$1" != -n ]; do shift; done\nexec tail -n "$2" /run/stand-in/log\n'
        )
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", root / "host_key"], check=True, timeout=PATIENCE_S
        )
        (root / "sshd_config").write_text(
            f"HostKey {root}/host_key\nAuthorizedKeysFile /etc/operator.pub\nListenAddress {address}\nStrictModes no\n"
            f"UsePAM no\nPidFile none\nPermitRootLogin yes\nSetEnv PATH={root}/bin:/usr/sbin:/usr/bin:/sbin:/bin\n"
        )

    def tool(self, name: str, text: str) -> None:
        """A program that comes first in the PATH of every session."""
        (self.root / "bin" / name).write_text(text)
        (self.root / "bin" / name).chmod(0o755)

    def start(self) -> None:
        """Power on: sshd, and nothing else until somebody logs in."""
        argv = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-ec", _ENTER, "machine"]
        environment = {
            "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
            "PREFIX": sys.base_prefix,
            "OVERLAY": "" if self.overlay is None else str(self.overlay),
            "OPT_KIB": "" if self._opt_kib is None else str(self._opt_kib),
        }
        self._server = _AtAddress([*argv, str(self.root), str(self.port)], self, environment)

    def stop(self) -> None:
        """Power off, at once and without a word to anyone."""
        if self._server is not None:
            self._server.stop()
            self._server = None

    @property
    def host_key(self) -> HostKey:
        return parse_key((self.root / "host_key.pub").read_text())

    def log_in(self, pins: Path) -> SshConnection:
        trust = TrustStore(pins)
        trust.replace("machine", self.host_key)
        return connect(
            Endpoint(self.address, self.port, identity="machine"),
            credentials=Credentials((self._key,), use_agent=False),
            trust=trust,
            deadlines=PATIENT,
        )

    def shell(self, command: str, pins: Path) -> str:
        """What a command prints there; it must succeed."""
        with self.log_in(pins) as connection:
            return connection.run(command).check(command).stdout


class _AtAddress(Server):
    """A server that is up once its own loopback address takes connections."""

    def __init__(self, argv: list[str], machine: Machine, environment: dict[str, str]) -> None:
        log = machine.root / "sshd.log"
        self.port = machine.port
        self._log = log
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                argv, stdout=output, stderr=output, stdin=subprocess.DEVNULL, env=environment
            )
        try:
            eventually(lambda: self._process.poll() is not None or b"listening on" in log.read_bytes())
            if self._process.poll() is not None:
                raise AssertionError(f"the machine did not start: {log.read_text()}")
        except BaseException:
            self.stop()
            raise


def key_pair(path: Path) -> Path:
    """A new key pair; the private file's path."""
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", path], check=True, timeout=PATIENCE_S)
    os.chmod(path, 0o600)
    return path
