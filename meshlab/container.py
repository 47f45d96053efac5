"""A node as a container: its own root file system, processes, network, host name and uptime.

`become_node` runs in a process just cloned into new namespaces, turns it into the node's process 1 and never returns.
The node sees the fleet directory's `nodes/NAME` as /lab/node:

    flash/      content that survives a power cut (`current` points at the valid copy of /etc, /root, /usr, /lib)
    firmware/   content of the flash chip: release, packages
    board       board name, MAC addresses, radios
    air/        state of its radios (written by the node) and what they receive (written by the fleet)
"""

from __future__ import annotations

import os
import signal
import time
import uuid
from dataclasses import dataclass
from pathlib import Path

from meshlab import namespaces as ns
from meshlab.rootfs import INIT_SHELL, library_folders

FLAGS = ns.CLONE_NEWNS | ns.CLONE_NEWPID | ns.CLONE_NEWNET | ns.CLONE_NEWUTS | ns.CLONE_NEWIPC
_DEVICES = ("null", "zero", "full", "random", "urandom", "tty")
# /tmp is limited to half of the memory, the default of the kernel's tmpfs
_TMP_SHARE = 2
# the machine's maximum process id (machine_root/init); its own processes count from 1, and see those of all nodes
PID_MAX = 4194304
_PIDS_PER_NODE = 65536
_ENVIRONMENT = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/", "TERM": "vt102"}


@dataclass(frozen=True, slots=True)
class Container:
    """`fleet` is the fleet's directory. `deny_setgroups`: it runs in an unprivileged user namespace."""

    name: str
    fleet: Path
    overlay_kib: int
    memory_kib: int
    deny_setgroups: bool
    # its network devices are real ones of the kernel; otherwise they are files in /sys
    real_devices: bool = False
    last_pid: int = 0
    """Process ids after process 1 begin behind this one: see `last_pid`."""

    @property
    def home(self) -> Path:
        return self.fleet / "nodes" / self.name

    @property
    def mount_point(self) -> Path:
        return self.fleet / "mnt" / self.name


def last_pid(number: int) -> int:
    """A start of the process ids of each node, so that no two nodes of one kernel have a process with the same id.

    cfg80211 knows the owner of a mesh or an IBSS, wpa_supplicant, by its netlink socket's id, which is the id of the
    process. When such a socket closes in any namespace, it leaves the cells whose owner has this id (nl80211.c,
    nl80211_netlink_notify): an `iw` on one node ended the mesh of another.
    """
    return PID_MAX - (number + 1) * _PIDS_PER_NODE


def prepare(container: Container) -> None:
    """Create the node's directories and the files that change with every boot: boot id and meminfo."""
    for folder in ("flash", "firmware", "air", "proc"):
        (container.home / folder).mkdir(parents=True, exist_ok=True)
    container.mount_point.mkdir(parents=True, exist_ok=True)
    (container.home / "proc" / "boot_id").write_text(f"{uuid.uuid4()}\n", encoding="ascii")
    write_meminfo(container, available_kib=container.memory_kib * 3 // 5)


def write_meminfo(container: Container, *, available_kib: int) -> None:
    """Set the node's /proc/meminfo; the kernel's own shows the host's memory to every container."""
    total = container.memory_kib
    lines = (
        ("MemTotal", total),
        ("MemFree", available_kib * 9 // 10),
        ("MemAvailable", available_kib),
        ("Buffers", total // 50),
        ("Cached", total // 10),
        ("Shmem", total // 100),
    )
    text = "".join(f"{f'{key}:':<16}{value:>8} kB\n" for key, value in lines)
    # written in place: the file is bind-mounted into the node, which would not see a new file
    (container.home / "proc" / "meminfo").write_text(text, encoding="ascii")


def become_node(container: Container, report: int, gate: int | None = None) -> None:
    """Turn this process into the node; on failure write the reason to the descriptor `report` and exit.

    First waits for a byte on `gate`, which is written when the node's devices are attached.
    """
    try:
        ns.die_with_parent()
        if gate is not None and not os.read(gate, 1):
            os._exit(111)
        _restore_signals()
        _reset_uptime()
        _mount_all(container)
        if container.deny_setgroups:
            ns.accept_setgroups()
        shell = INIT_SHELL if Path(INIT_SHELL).exists() else "/bin/sh"
        os.execve(shell, [shell, "/rom/lab/init"], _ENVIRONMENT)
    except OSError as error:
        os.write(report, str(error).encode())
    finally:
        os._exit(111)


def _restore_signals() -> None:
    for number in (signal.SIGPIPE, signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def _reset_uptime() -> None:
    """Start the node's uptime clocks at zero. Kernels before 5.6 have no time namespaces: the host's uptime stays."""
    if not os.path.exists("/proc/self/timens_offsets"):
        return
    ns.unshare(ns.CLONE_NEWTIME)
    # to the nanosecond: a node must never appear to have booted before it was powered on
    monotonic, boottime = (
        divmod(-time.clock_gettime_ns(clock), 10**9) for clock in (time.CLOCK_MONOTONIC, time.CLOCK_BOOTTIME)
    )
    with open("/proc/self/timens_offsets", "w", encoding="ascii") as offsets:
        offsets.write(f"monotonic {monotonic[0]} {monotonic[1]}\nboottime {boottime[0]} {boottime[1]}\n")


def _mount_all(container: Container) -> None:
    ns.make_private()
    root, home = container.mount_point, container.home
    rom = container.fleet / "rom"
    ns.mount("overlay", str(root), "tmpfs", ns.MS_NOATIME, f"size={container.overlay_kib}k,mode=755")
    for folder in ("dev", "etc", "lab", "lib", "mnt", "overlay", "proc", "rom", "root", "sys", "tmp", "usr"):
        (root / folder).mkdir()
    for link, target in (("bin", "rom/bin"), ("sbin", "rom/sbin"), ("var", "tmp")):
        (root / link).symlink_to(target)
    for folder in library_folders(rom):
        # /lib and /usr/lib are the node's own; other library folders are linked from the ROM
        if folder not in ("lib", "usr/lib") and not (root / folder).exists():
            (root / folder).parent.mkdir(parents=True, exist_ok=True)
            (root / folder).symlink_to(f"/rom/{folder}")
    ns.bind(str(rom), f"{root}/rom", read_only=True)
    ns.mount("lab", f"{root}/lab", "tmpfs", 0, "size=16k,mode=755")
    (root / "lab" / "node").mkdir()
    ns.bind(str(home), f"{root}/lab/node")
    (root / "lab" / "events").touch()
    ns.bind(str(container.fleet / "events"), f"{root}/lab/events")
    ns.mount("tmpfs", f"{root}/tmp", "tmpfs", ns.MS_NOSUID, f"size={container.memory_kib // _TMP_SHARE}k,mode=1777")
    ns.mount("sysfs", f"{root}/sys", "tmpfs", 0, "size=1m,mode=755")
    if container.real_devices:
        _real_devices(root)
    _devices(root)
    ns.mount("proc", f"{root}/proc", "proc", ns.MS_NOSUID | ns.MS_NODEV | ns.MS_NOEXEC)
    ns.bind(str(home / "proc" / "boot_id"), f"{root}/proc/sys/kernel/random/boot_id")
    ns.bind(str(home / "proc" / "meminfo"), f"{root}/proc/meminfo")
    if container.last_pid:
        Path("/proc/sys/kernel/ns_last_pid").write_text(f"{container.last_pid}\n", encoding="ascii")
    ns.pivot_root(str(root))
    ns.bind("/", "/overlay")


def _real_devices(root: Path) -> None:
    """Mount the kernel's sysfs for the node's network devices; lab/phys puts radios at the board's paths."""
    (root / "lab" / "sysfs").mkdir()
    ns.mount("sysfs", f"{root}/lab/sysfs", "sysfs")
    (root / "sys" / "class").mkdir()
    for link in ("class/net", "module"):
        (root / "sys" / link).symlink_to(f"/lab/sysfs/{link}")


def _devices(root: Path) -> None:
    ns.mount("tmpfs", f"{root}/dev", "tmpfs", ns.MS_NOSUID, "size=64k,mode=755")
    for name in _DEVICES:
        (root / "dev" / name).touch()
        ns.bind(f"/dev/{name}", f"{root}/dev/{name}")
    (root / "dev" / "pts").mkdir()
    ns.mount("devpts", f"{root}/dev/pts", "devpts", 0, "newinstance,ptmxmode=0666,mode=600")
    for link, target in (
        ("ptmx", "pts/ptmx"),
        ("fd", "/proc/self/fd"),
        ("stdin", "fd/0"),
        ("stdout", "fd/1"),
        ("stderr", "fd/2"),
    ):
        (root / "dev" / link).symlink_to(target)
