"""Robot computers for tests: a Debian of packages with a real systemd as its first process, and a real OpenSSH server.

`debian` has the root built (once; scripts/setup-robot-machine). A `Machine` is that root under a writable layer of its
own, booted in namespaces, with a cable in a `Lan`. What it wrote stays when it reboots or loses power.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from meshctl.device.connection import Credentials, Deadlines, Endpoint
from meshctl.device.errors import ConnectionLost
from meshctl.device.ssh import SshConnection, connect
from meshctl.device.trust import HostKey, TrustStore, parse_key
from tests.meshctl.device.servers import PATIENCE_S, eventually
from tests.meshctl.robots.lan import Lan

_DEBIAN_PYTHONS = {(3, 11): "bookworm", (3, 13): "trixie"}
_SUITE = _DEBIAN_PYTHONS.get(sys.version_info[:2], "trixie")
PYTHON = "python3" if sys.version_info[:2] in _DEBIAN_PYTHONS else f"/opt/python/bin/python3.{sys.version_info.minor}"
"""Tests deploy wheels made of their own packages: the Python of the Debian that has our version runs them; ours where
no Debian has it, on the newest, as a Python needs a C library no older than the one that it was built for."""
PATIENT = Deadlines(connect_s=60, handshake_s=120, auth_s=120, channel_s=120, run_s=120)
BUILD_TIMEOUT_S = 280
_SETUP = Path(__file__).parents[3] / "scripts/setup-robot-machine"
_BOOT = Path(__file__).with_name("boot_machine.sh")


def debian() -> Path:
    """The root that all machines stand on. Fails, and says why, where it can neither be found nor built."""
    done = subprocess.run([_SETUP, _SUITE], capture_output=True, text=True, timeout=BUILD_TIMEOUT_S, check=False)
    assert done.returncode == 0, f"no Debian machine to test on:\n{done.stderr}"
    return Path(done.stdout.strip())


class Machine:
    """One computer: `root` of the operator's key logs in at `address`. `opt_kib` gives /opt a small disk of its own;
    what is in `seed` lies over the Debian in `base`."""

    def __init__(
        self,
        base: Path,
        directory: Path,
        lan: Lan,
        address: str,
        key: Path,
        *,
        opt_kib: int | None = None,
        seed: Path | None = None,
    ) -> None:
        self.name = directory.name
        self.address = address
        self._base = base
        self._lower = str(base) if seed is None else f"{seed}:{base}"
        self._directory = directory
        self._key = key
        self._opt_kib = opt_kib
        self.network = lan.plug_in(address)
        self._process: subprocess.Popen[bytes] | None = None
        self._cgroup = _cgroup_root() / f"{self.name}-{os.getpid()}-{id(self):x}"
        for name in ("upper", "work", "root"):
            (directory / name).mkdir(parents=True)
        self.write("/etc/hostname", f"{self.name}\n")
        self.write("/etc/hosts", f"127.0.0.1 localhost\n127.0.1.1 {self.name}\n")
        self.write("/root/.ssh/authorized_keys", key.with_suffix(".pub").read_text())
        host_key = directory / "host_key"
        key_pair(host_key)
        self.host_key: HostKey = parse_key(host_key.with_suffix(".pub").read_text())
        self.write("/etc/ssh/ssh_host_ed25519_key", host_key.read_text(), 0o600)

    def write(self, path: str, text: str, mode: int = 0o644) -> None:
        """Put a file there before it is started for the first time."""
        assert self._process is None
        target = self._directory / "upper" / path.lstrip("/")
        for parent in reversed(target.relative_to(self._directory / "upper").parents):
            made = self._directory / "upper" / parent
            if not made.exists():
                made.mkdir()
                if (self._base / parent).is_dir():
                    shutil.copystat(self._base / parent, made)
        target.write_text(text)
        target.chmod(mode)

    def append(self, path: str, text: str) -> None:
        """`write`, below what Debian has there."""
        there = self._base / path.lstrip("/")
        self.write(path, there.read_text() + text, there.stat().st_mode & 0o7777)

    def start(self) -> None:
        """Power on, and wait until a login works."""
        self._cgroup.mkdir()
        enter = 'echo $$ >"$1/cgroup.procs" && shift && exec "$@"'
        namespaces = ["--pid", "--fork", "--kill-child", "--mount", "--uts", "--ipc", "--cgroup"]
        argv: list[str | Path] = [
            # nothing of it outlives the tests, however they end
            *("setpriv", "--pdeathsig", "KILL", "sh", "-c", enter, "enter", self._cgroup),
            *("nsenter", f"--net={self.network}", "unshare", *namespaces),
            *("sh", _BOOT, self._lower, self._directory, str(self._opt_kib or ""), sys.base_prefix),
        ]
        self._process = subprocess.Popen(
            argv,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        try:
            eventually(lambda: self._ended() or self.answers)
            if self._ended():
                assert self._process.stdout is not None
                raise AssertionError(f"{self.name} did not boot: {self._process.stdout.read().decode()}")
        except BaseException:
            self.stop()
            raise

    @property
    def answers(self) -> bool:
        """Whether its SSH server does."""
        try:
            with socket.create_connection((self.address, 22), timeout=5.0) as server:
                return server.recv(4) == b"SSH-"
        except OSError:
            return False

    def _ended(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def reboot(self, pins: Path) -> None:
        """As `systemctl reboot` does it: services stop in order, and everything starts again."""
        with suppress(ConnectionLost):
            # which may end before the command does
            self.shell("systemctl reboot", pins)
        eventually(self._ended)
        assert self._process is not None
        # what the kernel reports of a namespace whose first process asked for a restart: reboot(2)
        assert self._process.returncode == -signal.SIGHUP
        self.stop()
        self.start()

    def stop(self) -> None:
        """Power off, at once and without a word to anyone."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait(PATIENCE_S)
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._process = None
        eventually(lambda: "populated 0" in (self._cgroup / "cgroup.events").read_text())
        for directory, _, _ in os.walk(self._cgroup, topdown=False):
            os.rmdir(directory)

    def log_in(self, pins: Path, user: str = "root") -> SshConnection:
        trust = TrustStore(pins)
        trust.replace(self.name, self.host_key)
        return connect(
            Endpoint(self.address, user=user, identity=self.name),
            credentials=Credentials((self._key,), use_agent=False),
            trust=trust,
            deadlines=PATIENT,
        )

    def shell(self, command: str, pins: Path) -> str:
        """What a command prints there; it must succeed."""
        with self.log_in(pins) as connection:
            return connection.run(command).check(command).stdout


def _cgroup_root() -> Path:
    """Where this machine has its cgroup v2 hierarchy."""
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, where, kind, *_ = line.split()
        if kind == "cgroup2":
            return Path(where)
    raise AssertionError("a machine's systemd needs cgroup v2, and it is mounted nowhere here")


def key_pair(path: Path) -> Path:
    """A new key pair; the private file's path."""
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", path], check=True, timeout=PATIENCE_S)
    return path
