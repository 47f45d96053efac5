"""One QEMU machine: started with a timeout, its console kept, its process always ended.

`probe_accelerator` decides by a short boot whether /dev/kvm works on this host; `Machine.start` boots the image and
waits for `guest_protocol.READY` on the console.
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
from meshlab.kernel_log import CONSOLE
from meshlab.qemu.guest_protocol import ADDRESS, GATEWAY, NETWORK, PORT, READY
from meshlab.qemu.time_stamp_counter import counter_khz

QEMU = "qemu-system-x86_64"
_POLL_S = 0.1
# on working hardware a kernel prints its first line within a second
_PROBE_S = 15.0
_MEMORY_MIB = 640
_MEMORY_PER_NODE_MIB = 40
_PROCESSORS = 2
# TCG's translation cache: a smaller one retranslates more
_TRANSLATED_MIB = 192
_LAST_LINES = 25
# Debian's kernel clears every allocated page, and runs AppArmor, audit and memory accounting for every process: under
# emulation these take a good part of a process's start, and nodes start thousands. Address randomization makes TCG
# translate each program again at every start: without it dash takes 19 ms instead of 99, iw 60 instead of 144
_KERNEL_OPTIONS = "init_on_alloc=0 apparmor=0 audit=0 cgroup_disable=memory transparent_hugepage=never norandmaps"
# A CPU that has not scheduled for twice watchdog_thresh seconds never will: the kernel writes every CPU's stack to the
# console and panics, so that the machine ends with a reason instead of leaving each request to its timeout
_LOCKUP_OPTIONS = "loglevel=5 watchdog_thresh=30 softlockup_all_cpu_backtrace=1 softlockup_panic=1"
# a task that waits for longer is on the console before the request that waits for it ends (60 s, `client.request`)
_BLOCKED_OPTIONS = "sysctl.kernel.hung_task_timeout_secs=20"
_STOP_S = 10.0


@dataclass(frozen=True, slots=True)
class Accelerator:
    """QEMU's options for the accelerator and CPU."""

    options: tuple[str, ...]


KVM = Accelerator(("-accel", "kvm", "-cpu", "host"))
# TCG translates qemu64 faster than richer CPU models
TCG = Accelerator(("-accel", f"tcg,thread=multi,tb-size={_TRANSLATED_MIB}", "-cpu", "qemu64"))


def find_qemu() -> None:
    """Raises LabError when QEMU is not installed."""
    if shutil.which(QEMU) is None:
        raise LabError(
            f"`meshctl lab up --real` needs {QEMU}, which is not installed",
            hint="run scripts/setup-lab, or `apt install qemu-system-x86`",
        )


def cached_accelerator(kernel: Path, cache: Path) -> Accelerator:
    """`probe_accelerator`, run once per boot of the host and kept in `cache`."""
    cache_file = cache / "accelerator"
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    with contextlib.suppress(OSError, ValueError):
        known, word = cache_file.read_text(encoding="ascii").split()
        if known == boot:
            return KVM if word == "kvm" else TCG
    accelerator = probe_accelerator(kernel)
    cache_file.write_text(f"{boot} {'kvm' if accelerator is KVM else 'tcg'}\n", encoding="ascii")
    return accelerator


def probe_accelerator(kernel: Path, device: Path = Path("/dev/kvm")) -> Accelerator:
    """KVM if it exists and a kernel boots on it in time; else software emulation."""
    try:
        device.open("r+b", buffering=0).close()
    except OSError:
        return TCG
    with tempfile.TemporaryDirectory(prefix="meshctl-probe-") as folder:
        console = Path(folder) / "console"
        command = (
            QEMU, "-M", "q35", *KVM.options, "-m", "256", "-nodefaults", "-display", "none", "-no-reboot",
            "-kernel", str(kernel), "-append", "console=ttyS0 panic=-1", "-serial", f"file:{console}",
        )  # fmt: skip
        null = subprocess.DEVNULL
        with subprocess.Popen(command, stdin=null, stdout=null, stderr=null) as probe:
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
    """A machine with its console and QEMU's log in `directory`."""

    def __init__(self, directory: Path, kernel: Path, initrd: Path, *, radios: int, nodes: int) -> None:
        self.console = directory / CONSOLE
        self._directory = directory
        self._kernel = kernel
        self._initrd = initrd
        self._radios = radios
        self._memory_mib = _MEMORY_MIB + _MEMORY_PER_NODE_MIB * nodes
        self._process: subprocess.Popen[bytes] | None = None
        self.port = 0

    def start(self, accelerator: Accelerator, wait_s: float) -> None:
        """Boot it; returns when its supervisor is ready and `port` on 127.0.0.1 is forwarded to it.

        Raises LabError with the console's last lines when it ends or is not ready within `wait_s`; it is stopped then.
        """
        self.console.unlink(missing_ok=True)
        ours, theirs = socket.socketpair()
        with ours, theirs:
            with (self._directory / "qemu.log").open("wb") as errors:
                self._process = subprocess.Popen(
                    self._command(accelerator, theirs.fileno()),
                    stdin=subprocess.DEVNULL,
                    stdout=errors,
                    stderr=errors,
                    pass_fds=(theirs.fileno(),),
                    # safe: this process has one thread
                    preexec_fn=ns.die_with_parent,
                )
            theirs.close()
            try:
                self.port = _forwarded_port(ours)
                self._wait_ready(wait_s)
            except BaseException:
                self.stop()
                raise

    def _command(self, accelerator: Accelerator, monitor: int) -> tuple[str, ...]:
        khz = counter_khz() if accelerator is TCG else None
        clock = "tsc=reliable" if khz is None else f"tsc=reliable tsc_early_khz={khz}"
        line = (
            f"console=ttyS0 panic=-1 mitigations=off nokaslr random.trust_cpu=on no_timer_check {clock} "
            f"{_KERNEL_OPTIONS} {_LOCKUP_OPTIONS} {_BLOCKED_OPTIONS} lab.radios={self._radios}"
        )
        network = f"user,id=host,restrict=on,net={NETWORK},host={GATEWAY},hostfwd=tcp:127.0.0.1:0-{ADDRESS}:{PORT}"
        return (
            QEMU, "-M", "q35", *accelerator.options, "-smp", str(_PROCESSORS), "-m", str(self._memory_mib),
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
        """The last lines of its console."""
        if not self.console.exists():
            return ""
        text = self.console.read_text(encoding="utf-8", errors="replace").replace("\r", "")
        return "\n".join(text.splitlines()[-lines:])

    @property
    def pid(self) -> int:
        """QEMU's process id. Raises LabError when it is not running."""
        if self._process is None:
            raise LabError("the machine is not running")
        return self._process.pid

    def stop(self) -> None:
        """Stop it; the process has ended when this returns."""
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
    """The host port that QEMU chose for the forward, from its monitor."""
    monitor.settimeout(_PROBE_S)
    output = b""
    try:
        monitor.sendall(b"info usernet\n")
        while True:
            match = re.search(rb"TCP\[HOST_FORWARD\]\s+\d+\s+127\.0\.0\.1\s+(\d+)", output)
            if match:
                return int(match[1])
            more = monitor.recv(4096)
            if not more:
                raise LabError("QEMU ended immediately", hint="see qemu.log in the fleet's directory")
            output += more
    except OSError as error:
        raise LabError(f"QEMU's monitor did not answer: {error}") from error
