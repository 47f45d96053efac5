"""One QEMU machine: started within bounds, its console kept, ended for certain.

`accelerator` decides by a short boot whether /dev/kvm really works here; `Machine.start` boots the image and waits for
the words of `guest.READY` on its console.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import socket
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from meshlab import namespaces as ns
from meshlab.errors import LabError
from meshlab.qemu.guest_protocol import ADDRESS, GATEWAY, NETWORK, PORT, READY

QEMU = "qemu-system-x86_64"
_POLL_S = 0.1
# a kernel that runs on working hardware says its first words within a second
_PROBE_S = 15.0
_MEMORY_MIB = 640
_MEMORY_PER_NODE_MIB = 40
_PROCESSORS = 2
# translated code: more costs memory, less costs translating again
_TRANSLATED_MIB = 192
_LAST_LINES = 25
# Debian's kernel clears every page it gives out, and asks AppArmor, auditing and memory accounting about every process:
# under emulation that is a good part of what starting one costs, and nodes start thousands. And a program that lies at
# other addresses each time is translated each time: at the same ones dash takes 19 ms and not 99, iw 60 and not 144
_KERNEL_OPTIONS = "init_on_alloc=0 apparmor=0 audit=0 cgroup_disable=memory transparent_hugepage=never norandmaps"
_STOP_S = 10.0


@dataclass(frozen=True, slots=True)
class Accelerator:
    """QEMU's words for how the machine's processor is run, and whether that is fast."""

    options: tuple[str, ...]
    is_fast: bool


KVM = Accelerator(("-accel", "kvm", "-cpu", "host"), is_fast=True)
# qemu64 is translated faster than models that offer more
TCG = Accelerator(("-accel", f"tcg,thread=multi,tb-size={_TRANSLATED_MIB}", "-cpu", "qemu64"), is_fast=False)


def find_qemu() -> None:
    """Raises LabError naming the way to install it."""
    if shutil.which(QEMU) is None:
        raise LabError(
            f"the machine of real radios needs {QEMU}, which is not installed",
            hint="scripts/setup-lab installs it: apt install qemu-system-x86",
        )


def cached_accelerator(kernel: Path, cache: Path) -> Accelerator:
    """`accelerator`, found out once per boot of this machine and kept in `cache`."""
    note = cache / "accelerator"
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    with contextlib.suppress(OSError, ValueError):
        known, word = note.read_text(encoding="ascii").split()
        if known == boot:
            return KVM if word == "kvm" else TCG
    how = probe_accelerator(kernel)
    note.write_text(f"{boot} {'kvm' if how is KVM else 'tcg'}\n", encoding="ascii")
    return how


def probe_accelerator(kernel: Path, device: Path = Path("/dev/kvm")) -> Accelerator:
    """KVM if it is there and a kernel says something on it in time; else software emulation."""
    try:
        device.open("r+b", buffering=0).close()
    except OSError:
        return TCG
    with tempfile.TemporaryDirectory(prefix="meshctl-probe-") as folder:
        console = Path(folder) / "console"
        words = (
            QEMU, "-M", "q35", *KVM.options, "-m", "256", "-nodefaults", "-display", "none", "-no-reboot",
            "-kernel", str(kernel), "-append", "console=ttyS0 panic=-1", "-serial", f"file:{console}",
        )  # fmt: skip
        silence = subprocess.DEVNULL
        with subprocess.Popen(words, stdin=silence, stdout=silence, stderr=silence) as probe:
            try:
                deadline = time.monotonic() + _PROBE_S
                while probe.poll() is None and time.monotonic() < deadline:
                    if _kernel_started(console):
                        return KVM
                    time.sleep(_POLL_S)
            finally:
                probe.kill()
        return KVM if _kernel_started(console) else TCG


def _kernel_started(console: Path) -> bool:
    return console.exists() and b"Linux version" in console.read_bytes()


class Machine:
    """A machine whose files lie in `directory`: console, and the monitor's socket."""

    def __init__(self, directory: Path, kernel: Path, initrd: Path, *, radios: int, nodes: int) -> None:
        self.console = directory / "console"
        self._directory = directory
        self._kernel = kernel
        self._initrd = initrd
        self._radios = radios
        self._memory_mib = _MEMORY_MIB + _MEMORY_PER_NODE_MIB * nodes
        self._process: subprocess.Popen[bytes] | None = None
        self.port = 0

    def start(self, how: Accelerator, wait_s: float) -> None:
        """Boot it; returns when its supervisor is ready and `port` on 127.0.0.1 leads there.

        Raises LabError with the console's last lines when it ends or says nothing in time; it is stopped then.
        """
        self.console.unlink(missing_ok=True)
        ours, theirs = socket.socketpair()
        with ours, theirs:
            with (self._directory / "qemu.log").open("wb") as complaints:
                self._process = subprocess.Popen(
                    self._words(how, theirs.fileno()),
                    stdin=subprocess.DEVNULL,
                    stdout=complaints,
                    stderr=complaints,
                    pass_fds=(theirs.fileno(),),
                    # called in a process with one thread
                    preexec_fn=ns.die_with_parent,
                )
            theirs.close()
            try:
                self.port = _forwarded_port(ours)
                self._wait_ready(wait_s)
            except BaseException:
                self.stop()
                raise

    def _words(self, how: Accelerator, monitor: int) -> tuple[str, ...]:
        line = (
            "console=ttyS0 quiet panic=-1 mitigations=off nokaslr random.trust_cpu=on no_timer_check tsc=reliable "
            f"{_KERNEL_OPTIONS} lab.radios={self._radios}"
        )
        network = f"user,id=host,restrict=on,net={NETWORK},host={GATEWAY},hostfwd=tcp:127.0.0.1:0-{ADDRESS}:{PORT}"
        return (
            QEMU, "-M", "q35", *how.options, "-smp", str(_PROCESSORS), "-m", str(self._memory_mib),
            "-nodefaults", "-display", "none", "-no-reboot",
            "-kernel", str(self._kernel), "-initrd", str(self._initrd), "-append", line,
            "-netdev", network, "-device", "virtio-net-pci,netdev=host,romfile=", "-device", "virtio-rng-pci",
            "-serial", f"file:{self.console}",
            "-chardev", f"socket,id=monitor,fd={monitor}", "-mon", "chardev=monitor,mode=readline",
        )  # fmt: skip

    def _wait_ready(self, wait_s: float) -> None:
        deadline = time.monotonic() + wait_s
        while READY not in self.console_tail(lines=10_000):
            if self._process is None or self._process.poll() is not None:
                raise LabError("the machine ended while it started", hint=self.console_tail())
            if time.monotonic() > deadline:
                raise LabError(f"the machine was not ready within {wait_s:g} s", hint=self.console_tail())
            time.sleep(_POLL_S)

    def console_tail(self, lines: int = _LAST_LINES) -> str:
        """The end of its console."""
        if not self.console.exists():
            return ""
        text = self.console.read_text(encoding="utf-8", errors="replace").replace("\r", "")
        return "\n".join(text.splitlines()[-lines:])

    @property
    def pid(self) -> int:
        """QEMU's process. Raises LabError when it does not run."""
        if self._process is None:
            raise LabError("the machine does not run")
        return self._process.pid

    def stop(self) -> None:
        """End it; nothing of it is left when this returns."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _forwarded_port(monitor: socket.socket) -> int:
    """The free port that QEMU took for the forward, as its monitor tells."""
    monitor.settimeout(_PROBE_S)
    said = b""
    try:
        monitor.sendall(b"info usernet\n")
        while True:
            match = re.search(rb"TCP\[HOST_FORWARD\]\s+\d+\s+127\.0\.0\.1\s+(\d+)", said)
            if match:
                return int(match[1])
            more = monitor.recv(4096)
            if not more:
                raise LabError("QEMU ended at once", hint="its words are in qemu.log, beside the console")
            said += more
    except OSError as error:
        raise LabError(f"QEMU's monitor did not answer: {error}") from error
