"""A node small enough to be cut to pieces: a root of its own with the real busybox ash, entered by mount namespace.

`Sandbox` makes the root; stand-ins are only `uci`, which here greps, `sync`, which does nothing, and `reboot`, which
writes a line. `run` enters it. Its flash is `etc/`, its RAM `tmp/`; `reboot()` empties the RAM and changes the boot id,
as a power cut does.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import uuid
from contextlib import suppress
from pathlib import Path

from meshctl.device.scripts import script

BUSYBOX = shutil.which("busybox") or "/bin/busybox"

# What stands where OpenWrt's own tools would; busybox's applets are the real ones.
UCI = """#!/bin/sh
case $1 in
changes) [ ! -f /tmp/.uci/delta ] || cat /tmp/.uci/delta ;;
-c) ! grep -q BROKEN "$2/$4" ;;
esac
"""
# The machine's disks need no flushing for a test, and on a busy one that takes seconds.
SYNC = """#!/bin/sh
"""
REBOOT = """#!/bin/sh
echo reboot >>/harness/reboots
"""

ENTER = r"""
root=$1; shift
mount --bind "$root" "$root"
mount --rbind /proc "$root/proc"
mount --rbind /dev "$root/dev"
mount --rbind /sys "$root/sys"
mount --bind "$root/harness/boot_id" "$root/proc/sys/kernel/random/boot_id"
cd "$root"
exec chroot "$root" "$@"
"""


DIRECTORIES = (
    *("bin", "sbin", "usr/sbin", "tmp", "proc", "sys", "dev", "harness"),
    *("etc/config", "etc/init.d", "etc/rc.d"),
)


class Sandbox:
    """One node's root below `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for directory in DIRECTORIES:
            (root / directory).mkdir(parents=True)
        shutil.copy2(BUSYBOX, root / "bin/busybox")
        (root / "bin/sh").symlink_to("busybox")
        self.put("/sbin/uci", UCI, 0o755)
        self.put("/bin/sync", SYNC, 0o755)
        self.put("/sbin/reboot", REBOOT, 0o755)
        self.put("/usr/sbin/meshctl-deadman", script("deadman.sh"), 0o755)
        self.put("/etc/init.d/meshctl-deadman", script("deadman.init"), 0o755)
        (root / "etc/rc.d/S05meshctl-deadman").symlink_to("../init.d/meshctl-deadman")
        self.reboot()

    def path(self, on_node: str) -> Path:
        return self.root / on_node.lstrip("/")

    def put(self, on_node: str, text: str | bytes, mode: int = 0o644) -> None:
        path = self.path(on_node)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        path.chmod(mode)

    def text(self, on_node: str) -> str | None:
        path = self.path(on_node)
        return path.read_text() if path.is_file() else None

    def reboot(self) -> None:
        """The power is back: RAM is empty, the boot id is new; the boot hook has not run yet."""
        shutil.rmtree(self.path("/tmp"))
        self.path("/tmp").mkdir()
        self.put("/harness/boot_id", f"{uuid.uuid4()}\n")

    def close(self) -> None:
        """End what still runs in the node: forget the change, which ends its timers, and stop what does not heed it."""
        shutil.rmtree(self.path("/etc/meshctl"), ignore_errors=True)
        self.close_processes()

    def close_processes(self) -> None:
        """End everything that runs in the node, as a power cut does."""
        while running := self.processes():
            for number in running:
                with suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)

    def processes(self) -> list[int]:
        """What runs in the node now."""
        # once, and without a Path for each: a test asks again and again, of all processes of the machine
        root = os.path.realpath(self.root)
        found = []
        for name in os.listdir("/proc"):
            # what ends meanwhile, or is another user's, cannot be looked at
            with suppress(OSError):
                if name.isdecimal() and os.readlink(f"/proc/{name}/root") == root:
                    found.append(int(name))
        return found

    def argv(self, *command: str) -> list[str]:
        unshare = ["unshare", "--mount"] if os.geteuid() == 0 else ["unshare", "--mount", "--user", "--map-root-user"]
        # busybox has mount and chroot in itself: half the processor time of programs of their own, which counts in
        # thousands of commands
        return [*unshare, BUSYBOX, "sh", "-ec", ENTER, "enter", str(self.root), *command]

    def run(self, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run a command in the node to its end, in a process group of its own; never raises on its status."""
        done = subprocess.run(
            self.argv(*command),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=120,
            env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", **environment},
            start_new_session=True,
            check=False,
        )
        return subprocess.CompletedProcess(
            done.args, done.returncode, done.stdout.decode("utf-8", "replace"), done.stderr.decode("utf-8", "replace")
        )

    def deadman(self, *words: str) -> str:
        """One verb of the dead-man's switch; its answer's line."""
        return self.run("/usr/sbin/meshctl-deadman", *words).stdout.strip()
