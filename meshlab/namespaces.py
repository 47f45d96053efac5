"""System calls that Python does not offer: namespaces, mounts, and a seccomp filter.

A fleet uses them in this order: `enter_user_namespace` (when not root), `enter_quick_network`, `clone` into new
namespaces for each node, `mount`/`bind`/`pivot_root` inside it, `accept_setgroups`, and `setns` to enter a running
node. Every function raises OSError with the kernel's errno. Numbers are from the kernel's uapi headers.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import platform
import signal
import struct
from pathlib import Path
from typing import NamedTuple

CLONE_NEWNS = 0x00020000
CLONE_NEWUTS = 0x04000000
CLONE_NEWIPC = 0x08000000
CLONE_NEWUSER = 0x10000000
CLONE_NEWPID = 0x20000000
CLONE_NEWNET = 0x40000000
CLONE_NEWTIME = 0x00000080

MS_RDONLY = 0x1
MS_NOSUID = 0x2
MS_NODEV = 0x4
MS_NOEXEC = 0x8
MS_REMOUNT = 0x20
MS_NOATIME = 0x400
MS_BIND = 0x1000
MS_REC = 0x4000
MS_PRIVATE = 0x40000
MS_RELATIME = 0x200000
_MNT_DETACH = 0x2

_PR_SET_PDEATHSIG = 1
_PR_SET_NO_NEW_PRIVS = 38
_PR_SET_SECCOMP = 22
_SECCOMP_MODE_FILTER = 2
_SECCOMP_RET_ALLOW = 0x7FFF0000
_SECCOMP_RET_ERRNO = 0x00050000

# the size of the table of a network that a process of this one makes; a node has few connections
_CHILD_TABLE = Path("/proc/sys/net/ipv4/tcp_child_ehash_entries")
_TABLE_ENTRIES = 1024

_libc = ctypes.CDLL(None, use_errno=True)


class _Machine(NamedTuple):
    """System call numbers and the audit architecture of one machine type."""

    clone: int
    pivot_root: int
    setgroups: int
    audit: int


_MACHINES = {
    "x86_64": _Machine(clone=56, pivot_root=155, setgroups=116, audit=0xC000003E),
    "aarch64": _Machine(clone=220, pivot_root=41, setgroups=159, audit=0xC00000B7),
}


def machine_is_known() -> bool:
    """Whether this machine's system call numbers are known here."""
    return platform.machine() in _MACHINES


def enter_user_namespace() -> None:
    """Become root of a new user namespace that maps only the caller's user and group.

    The caller must be single-threaded. The kernel then refuses setgroups (see `accept_setgroups`).
    """
    uid, gid = os.geteuid(), os.getegid()
    _check(_libc.unshare(CLONE_NEWUSER), "unshare(CLONE_NEWUSER)")
    Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
    Path("/proc/self/uid_map").write_text(f"0 {uid} 1", encoding="ascii")
    Path("/proc/self/gid_map").write_text(f"0 {gid} 1", encoding="ascii")


def clone(flags: int) -> int:
    """Fork into new namespaces; returns 0 in the child, the child's pid in the parent.

    os.fork takes no flags, and unshare(CLONE_NEWPID) works only once per process. The caller must be single-threaded,
    and the child should do little before it calls exec.
    """
    pid = _libc.syscall(_MACHINES[platform.machine()].clone, ctypes.c_ulong(flags | signal.SIGCHLD), 0, 0, 0, 0)
    return _check(pid, "clone")


def unshare(flags: int) -> None:
    _check(_libc.unshare(flags), "unshare")


def enter_quick_network() -> int:
    """Enter a new network whose own new networks have small tables of TCP connections; returns its descriptor.

    All networks of a machine share one table, sized for its memory, and reading /proc/net/tcp searches all of it: 4 ms
    with 24 GiB, and each dropbear reads it for its random numbers. Kernels before 6.1 have no other tables.
    """
    unshare(CLONE_NEWNET)
    with contextlib.suppress(FileNotFoundError):
        _CHILD_TABLE.write_text(f"{_TABLE_ENTRIES}\n", encoding="ascii")
    return os.open("/proc/self/ns/net", os.O_RDONLY | os.O_CLOEXEC)


def setns(descriptor: int, kind: int) -> None:
    """Enter the namespace of `descriptor` (a file of /proc/PID/ns); `kind` is its CLONE_NEW* flag."""
    _check(_libc.setns(descriptor, kind), "setns")


def mount(source: str, target: str, fs_type: str, flags: int = 0, options: str = "") -> None:
    status = _libc.mount(
        source.encode(), target.encode(), fs_type.encode() or None, ctypes.c_ulong(flags), options.encode() or None
    )
    _check(status, f"mount {fs_type or source} on {target}")


def bind(source: str, target: str, *, read_only: bool = False) -> None:
    """Bind-mount `source` at `target`. A remount keeps the flags that an outer mount namespace locked."""
    mount(source, target, "", MS_BIND)
    if read_only:
        mount("", target, "", MS_BIND | MS_REMOUNT | MS_RDONLY | _locked_flags(target))


def make_private() -> None:
    """Stop mounts of this mount namespace from propagating to others."""
    try:
        mount("none", "/", "", MS_REC | MS_PRIVATE)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        reason = "the root directory is not a mount point (a chroot?): run `mount --bind DIR DIR` before `chroot DIR`"
        raise OSError(error.errno, reason) from error


def pivot_root(new_root: str) -> None:
    """Make `new_root` (a mount point) the root of this mount namespace and unmount the old one."""
    os.chdir(new_root)
    number = _MACHINES[platform.machine()].pivot_root
    _check(_libc.syscall(number, b".", b"."), "pivot_root")
    # with "." twice the old root lies on top of the new one (pivot_root(2), NOTES)
    _check(_libc.umount2(b".", _MNT_DETACH), "umount of the old root")
    os.chdir("/")


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent thread ends (prctl(2), PR_SET_PDEATHSIG)."""
    _check(_libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0), "prctl(PR_SET_PDEATHSIG)")


def accept_setgroups() -> None:
    """Make setgroups(2) succeed without effect for this process and its children.

    An unprivileged user namespace must deny setgroups, but dropbear calls it at every login; with one user and one
    group in the namespace there is nothing to change.
    """
    machine = _MACHINES[platform.machine()]
    load, jump_if_equal, give = 0x20, 0x15, 0x06
    offset_of_number, offset_of_arch = 0, 4
    program = (
        (load, 0, 0, offset_of_arch),
        (jump_if_equal, 0, 3, machine.audit),
        (load, 0, 0, offset_of_number),
        (jump_if_equal, 0, 1, machine.setgroups),
        (give, 0, 0, _SECCOMP_RET_ERRNO),
        (give, 0, 0, _SECCOMP_RET_ALLOW),
    )
    code = b"".join(struct.pack("HBBI", *instruction) for instruction in program)
    buffer = ctypes.create_string_buffer(code, len(code))
    header = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program), ctypes.addressof(buffer)))
    if _libc.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(header), 0, 0) != 0:
        # without CAP_SYS_ADMIN the kernel requires no_new_privs
        _check(_libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "prctl(PR_SET_NO_NEW_PRIVS)")
        _check(_libc.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(header), 0, 0), "seccomp")


def _locked_flags(path: str) -> int:
    present = os.statvfs(path).f_flag
    pairs = (
        (os.ST_NOSUID, MS_NOSUID),
        (os.ST_NODEV, MS_NODEV),
        (os.ST_NOEXEC, MS_NOEXEC),
        (os.ST_NOATIME, MS_NOATIME),
        (os.ST_RELATIME, MS_RELATIME),
    )
    return sum(flag for bit, flag in pairs if present & bit)


def _check(status: int, attempted: str) -> int:
    if status < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{attempted}: {os.strerror(number)} ({errno.errorcode.get(number, number)})")
    return status
