"""One computer of a live team: namespace, interfaces, disk, clock and daemon."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.udp_mesh.daemon.live.ether import Ether
from tests.udp_mesh.daemon.live.programs import Broken, Reader, Writer
from tests.udp_mesh.daemon.live.radio import Radio, run
from tests.udp_mesh.daemon.processes import KEY, RunningDaemon, poll

TOPICS = """
stop = { priority = 0 }
pose = { priority = 2, keep_last = 1, deadline_s = 0.5 }
order = { priority = 3, deadline_s = 3.0 }
status = { priority = 4, keep_last = 2 }
view = { priority = 5, reliable = false }
kept = { priority = 6, outbox = "all", outbox_bytes = 2000000 }
newest = { priority = 6, outbox = "last" }
stored = { priority = 7, outbox = "all", outbox_on_disk = true }
limited = { priority = 7, rate_limit_bytes_per_s = 40000 }
map = { priority = 9, compression = true }
grid = { priority = 10, delta = true }
alert = { priority = 1, repair = true, reliable = false }
artifact = { priority = 4, log = { readers = ["a", "b"] } }
"""
LOG_READERS = ("a", "b")
BEST_EFFORT = ("view", "alert")
OUTBOXES = ("kept", "newest", "stored")
NEVER_EXPIRE = ("stop", "stored", "limited", "map", "grid")
"""Topics without deadline, `keep_last` or small outbox: their messages only end as delivered, unwanted or with their
peer lost."""
DISK_BYTES = 40_000_000
PASSED_ON_S = 10.0
"""Between the acknowledgment and the program's socket lies one turn of a daemon, even on a busy machine."""
RATES = """
[rates]
heartbeat_s = 0.2
heartbeat_sparse_s = 0.5
offline_s = 3.0
peer_lost_s = 8.0
"""


class Robot:
    """One computer: a namespace, an interface or two, a disk and a daemon."""

    def __init__(
        self,
        folder: Path,
        name: str,
        place: int,
        ethers: Sequence[Ether],
        *,
        ipv6: bool = False,
        key: str = KEY,
        called: str = "",
        version: Path | None = None,
        more: str = "",
    ) -> None:
        """`version` is a checkout of another version, whose daemon runs here; `more` is of its configuration."""
        self.name, self.place = name, place
        self.radios = [Radio(name, place, number, ether, ipv6=ipv6) for number, ether in enumerate(ethers)]
        self.called = called or name
        """What its daemon says it is called."""
        self.more = more
        self.runs = 0
        self.suspended = False
        self.reader: Reader | None = None
        self.writer: Writer | None = None
        self._filler = folder / f"{name}.disk" / "filler"
        self._is_freed = True
        self._clock = folder / f"{name}.clock"
        self._clock.touch()
        self._counts_turns = version is None
        # Ends with this process, whose end of the pipe is then closed.
        self.holder = subprocess.Popen(["unshare", "--net", "cat"], stdin=subprocess.PIPE)
        disk = folder / f"{name}.disk"
        disk.mkdir()
        run(f"mount -t tmpfs -o size={DISK_BYTES} none {disk}")
        (folder / f"{name}.key").write_text(key + "\n")
        self.daemon = RunningDaemon(folder, name, self.configuration(folder))
        self.daemon.prefix = ["nsenter", "-t", str(self.holder.pid), "-n", "--"]
        if version is None:
            self.daemon.module = ["tests.udp_mesh.daemon.live.stepped_clock", str(self._clock)]
        else:
            self.daemon.prefix += ["env", "--chdir", str(version)]

    def attach(self) -> None:
        """Make the interfaces."""
        poll(self._has_namespace, f"a network namespace for {self.name}")
        self.ip("link set lo up")
        # As systemd sets it: a second address stays when the first one goes.
        promote = "echo 1 > /proc/sys/net/ipv4/conf/all/promote_secondaries"
        subprocess.run(["nsenter", "-t", str(self.holder.pid), "-n", "sh", "-c", promote], check=True)
        for radio in self.radios:
            radio.attach(self.holder.pid, self.ip)

    def _has_namespace(self) -> bool:
        """`unshare` has left this namespace, so that the interface can be moved."""
        return Path(f"/proc/{self.holder.pid}/ns/net").readlink() != Path("/proc/self/ns/net").readlink()

    def configuration(self, folder: Path, stop_priority: int = 0, topics: str = TOPICS) -> str:
        return f"""
name = "{self.called}"
key_file = "{folder}/{self.name}.key"
[topics]
{topics.replace("priority = 0", f"priority = {stop_priority}")}
{RATES}
{self.more}
[daemon]
socket = "{folder}/{self.name}.sock"
state_directory = "{folder}/{self.name}.disk"
"""

    def ip(self, words: str) -> None:
        """`ip WORDS` in its namespace."""
        run(f"nsenter -t {self.holder.pid} -n ip {words}")

    def start(self) -> None:
        if self.daemon.process is None:
            self.runs += 1
            self.daemon.start()

    @property
    def running(self) -> bool:
        return self.daemon.process is not None and not self.suspended

    def suspend(self) -> None:
        self.daemon.signal(signal.SIGSTOP)
        self.suspended = True

    def resume(self) -> None:
        if self.suspended:
            self.daemon.signal(signal.SIGCONT)
        self.suspended = False

    def end(self, *, politely: bool) -> None:
        """End the daemon; its programs lose their connection."""
        self.resume()
        for program in (self.reader, self.writer):
            if program is not None:
                program.close()
        self.reader = self.writer = None
        if politely:
            if (code := self.daemon.stop()) != 0:
                raise Broken(f"{self.name} ended with {code}: {self.daemon.log.read_text()[-2000:]}")
        elif self.daemon.process is not None:
            self.daemon.kill()

    def refuse_some(self, errors: str) -> None:
        """The kernel refuses some datagrams with these errors."""
        self._clock.with_suffix(".refused").write_text(errors)

    def refuse_none(self) -> None:
        self._clock.with_suffix(".refused").unlink(missing_ok=True)

    def set_busy(self, busy: bool) -> None:
        """Turns of the daemon's event loop come late from now on, or no longer."""
        if busy:
            self._clock.with_suffix(".busy").touch()
        else:
            self._clock.with_suffix(".busy").unlink(missing_ok=True)

    def turns(self) -> int | None:
        """Turns of the daemon's event loop so far (None: of another version, which does not count them)."""
        return int.from_bytes(self._clock.with_suffix(".turns").read_bytes(), "little") if self._counts_turns else None

    def start_second(self) -> None:
        """Start the daemon once more while it runs. Raises Broken unless that is refused."""
        command = [*self.daemon.prefix, sys.executable, "-m", *self.daemon.module, "run", str(self.daemon.file)]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode == 0 or "Traceback" in done.stderr:
            raise Broken(f"a second daemon of {self.name} ended with {done.returncode}: {done.stderr[-2000:]}")

    def set_disk(self, access: str) -> None:
        """Make the disk read-only (`ro`) or writable (`rw`)."""
        run(f"mount -o remount,{access} {self._filler.parent}")
        if access == "rw" and self._is_freed:
            self.free_disk()

    def set_clock(self, offset_s: float) -> None:
        """Sets the daemon's wall clock to the host's and so much."""
        with self._clock.open("a") as file:
            file.write(f"{offset_s}\n")

    def fill_disk(self) -> None:
        self._is_freed = False
        with contextlib.suppress(OSError), self._filler.open("wb") as file:
            while True:
                file.write(bytes(4096))
                file.flush()

    def free_disk(self) -> None:
        """A disk that is read-only is freed once it is writable."""
        self._is_freed = True
        with contextlib.suppress(OSError):
            self._filler.unlink(missing_ok=True)

    def usage(self) -> tuple[float, int]:
        """Seconds of processor used, and memory in bytes."""
        assert self.daemon.process is not None
        stat = Path(f"/proc/{self.daemon.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(stat[11]) + int(stat[12])) / 100, int(stat[21]) * 4096

    def close(self) -> None:
        with contextlib.suppress(Broken):
            self.end(politely=True)
        for radio in self.radios:
            radio.close()
        self.holder.kill()
        self.holder.wait()
