"""Network namespaces joined by the emulated link: create, tune while running, count, remove.

`Laboratory` compiles the emulator if its source is newer, creates one namespace per host, starts the emulator with one
port in each, sets addresses 10.99.0.1, .2, ... and permanent neighbor entries (so that ARP under loss is not measured).
Needs root. All names contain the process id, so that laboratories do not conflict.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

SOURCE = Path(__file__).with_name("emulator.c")
INTERFACE = "mesh0"
# a healthy emulator is ready within milliseconds; a busy machine may need longer
READY_TIMEOUT_S = 30.0
ANSWER_TIMEOUT_S = 10.0
# a frame of the EtherType for local experiments, which nothing answers
_TEACH = """import socket, sys
with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as teacher:
    teacher.bind((sys.argv[1], 0))
    teacher.send(bytes.fromhex("ffffffffffff") + teacher.getsockname()[4] + bytes.fromhex("88b5") + bytes(46))
"""


@dataclass(frozen=True, slots=True)
class Link:
    """`queue` is in frames, `attempts` are the radio's transmissions per frame, `half` shares one transmitter among all
    hosts; `burst_*` are the Gilbert-Elliott chain's probabilities per frame."""

    rate: float = 10e6
    delay_ms: float = 10.0
    loss: float = 0.0
    burst_enter: float = 0.0
    burst_leave: float = 1.0
    burst_loss: float = 1.0
    queue: int = 100
    overhead_us: float = 0.0
    attempts: int = 1
    half: int = 0
    up: int = 1

    def as_settings(self) -> dict[str, float]:
        return {name: float(getattr(self, name)) for name in self.__slots__}


@dataclass(frozen=True, slots=True)
class PortCount:
    """One host's counters since the last reset; bytes are of IP packets."""

    in_frames: int
    in_bytes: int
    queue_drops: int
    losses: int
    down_drops: int
    out_frames: int
    out_bytes: int
    max_waiting: int


@dataclass(frozen=True, slots=True)
class Count:
    """`airtime_s` is the time the transmitters were busy, retries included; `in_flight` are frames on their way."""

    airtime_s: float
    in_flight: int
    ports: tuple[PortCount, ...]


class LaboratoryError(RuntimeError):
    """The emulator or a namespace could not be set up, or the emulator did not answer `ok`."""


def compiled(source: Path, directory: Path, *flags: str) -> Path:
    """Compile one C source to a program (or, with `-shared`, a library) in `directory`."""
    program = directory / source.stem
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise LaboratoryError("no C compiler found (install gcc)")
    done = subprocess.run(
        [compiler, "-O2", "-Wall", *flags, "-o", str(program), str(source)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise LaboratoryError(f"{source} does not compile:\n{done.stderr}")
    return program


class Laboratory:
    """Hosts on one link. Use `laboratory(...)`, which removes everything afterwards."""

    def __init__(self, hosts: int, seed: int, directory: Path, prefix: str) -> None:
        self.namespaces = tuple(f"{prefix}{index}" for index in range(hosts))
        self.addresses = tuple(f"10.99.0.{index + 1}" for index in range(hosts))
        self.directory = directory
        self._seed = seed
        self._emulator: subprocess.Popen[str] | None = None
        self._control: socket.socket | None = None
        self._made: list[str] = []

    def start(self) -> None:
        for namespace in self.namespaces:
            _ip("netns", "add", namespace)
            self._made.append(namespace)
            _ip("-n", namespace, "link", "set", "lo", "up")
        self._join()
        for namespace, address in zip(self.namespaces, self.addresses, strict=True):
            _ip("-n", namespace, "addr", "add", f"{address}/24", "brd", "10.99.0.255", "dev", INTERFACE)
            # IPv6's background traffic would be counted as the transport's
            self.run(self.namespaces.index(namespace), ["sysctl", "-qw", "net.ipv6.conf.all.disable_ipv6=1"])
            # only the emulator's queue may overflow
            _ip("-n", namespace, "link", "set", INTERFACE, "mtu", "1500", "txqueuelen", "20000", "up")
        self._set_permanent_neighbors()

    def _join(self) -> None:
        """Create an interface in each namespace, all on one link."""
        program = compiled(SOURCE, self.directory)
        path = str(self.directory / "control")
        self._emulator = subprocess.Popen(
            [str(program), path, str(self._seed), *(f"{name}:{INTERFACE}" for name in self.namespaces)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._emulator.stdout is not None
        readable, _, _ = select.select([self._emulator.stdout], [], [], READY_TIMEOUT_S)
        if not readable or self._emulator.stdout.readline() != "ready\n":
            raise LaboratoryError("the emulator did not start")
        self._control = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._control.bind(f"{path}.answer")
        self._control.connect(path)
        self._control.settimeout(ANSWER_TIMEOUT_S)

    def _set_permanent_neighbors(self) -> None:
        macs = []
        for namespace in self.namespaces:
            shown = json.loads(_ip("-n", namespace, "-j", "link", "show", INTERFACE))
            macs.append(shown[0]["address"])
        for here, namespace in enumerate(self.namespaces):
            for there, address in enumerate(self.addresses):
                if there != here:
                    _ip("-n", namespace, "neigh", "replace", address, "lladdr", macs[there], "dev", INTERFACE,
                        "nud", "permanent")  # fmt: skip
        self._teach()

    def _teach(self) -> None:
        """One frame from each host teaches the emulator the port of every address. When this returns, they are counted
        and gone."""
        for here, _ in enumerate(self.namespaces):
            self.run(here, ["python3", "-c", _TEACH, INTERFACE])
        end = time.monotonic() + READY_TIMEOUT_S
        while (counted := self.count()).in_flight or not all(port.in_frames for port in counted.ports):
            if time.monotonic() > end:
                raise LaboratoryError(f"the emulator has not learned all ports: {counted}")
            time.sleep(0.001)
        self.reset()

    def set(self, **settings: float) -> None:
        """Change the link now; names and units as in `Link`."""
        answer = self._ask("set " + " ".join(f"{name}={value}" for name, value in settings.items()))
        if answer != "ok":
            raise LaboratoryError(answer)

    def become(self, link: Link) -> None:
        """Set all parameters of the link."""
        self.set(**link.as_settings())

    def bring_together(self, *groups: Sequence[int]) -> None:
        """Hosts reach those of their own group alone, as radios out of range of the others; one that is in none of them
        reaches no other. Their interfaces stay up."""
        of_host = {host: number for number, group in enumerate(groups) for host in group}
        alone = range(len(groups), len(groups) + len(self.namespaces))
        numbers = (of_host.get(host, alone[host]) for host in range(len(self.namespaces)))
        answer = self._ask("groups " + " ".join(map(str, numbers)))
        if answer != "ok":
            raise LaboratoryError(answer)

    def count(self) -> Count:
        answer = json.loads(self._ask("count"))
        ports = tuple(PortCount(**port) for port in answer["ports"])
        return Count(answer["airtime_ns"] / 1e9, answer["in_flight"], ports)

    def reset(self) -> None:
        self._ask("reset")

    def _ask(self, command: str) -> str:
        if self._control is None:
            raise LaboratoryError("the laboratory is not started")
        self._control.send(command.encode())
        return self._control.recv(65536).decode()

    def inside(self, host: int, command: Sequence[str]) -> list[str]:
        """The command line to run `command` on a host."""
        return ["ip", "netns", "exec", self.namespaces[host], *command]

    def run(self, host: int, command: Sequence[str]) -> str:
        """Run to the end; returns the output."""
        return subprocess.run(self.inside(host, command), check=True, capture_output=True, text=True).stdout

    def popen(self, host: int, command: Sequence[str], environ: Mapping[str, str] | None = None,
              stderr: int | None = None) -> subprocess.Popen[bytes]:  # fmt: skip
        """Start a process, which the caller must end."""
        return subprocess.Popen(self.inside(host, command), env={**os.environ, **(environ or {})}, stderr=stderr)

    def stop(self) -> None:
        if self._control is not None:
            self._control.close()
        if self._emulator is not None:
            self._emulator.terminate()
            self._emulator.wait()
            if self._emulator.stdout is not None:
                self._emulator.stdout.close()
        for namespace in self._made:
            _ip("netns", "del", namespace)
        self._made.clear()


class Wire(Laboratory):
    """Two hosts on a veth pair at the kernel's speed: no emulator, and no counters."""

    def _join(self) -> None:
        here, there = self.namespaces
        _ip("link", "add", INTERFACE, "netns", here, "type", "veth", "peer", "name", INTERFACE, "netns", there)

    def _teach(self) -> None:
        """Not needed: there is no emulator."""

    def set(self, **settings: float) -> None:
        """Not supported: a veth pair has no parameters."""

    def bring_together(self, *groups: Sequence[int]) -> None:
        """Not supported: a veth pair has no groups."""

    def count(self) -> Count:
        nothing = PortCount(0, 0, 0, 0, 0, 0, 0, 0)
        return Count(0.0, 0, (nothing, nothing))

    def reset(self) -> None:
        """Not supported: a veth pair has no counters."""


L = TypeVar("L", bound=Laboratory)


@contextmanager
def _started(kind: type[L], hosts: int, seed: int) -> Iterator[L]:
    with tempfile.TemporaryDirectory(prefix="link-") as directory:
        made = kind(hosts, seed, Path(directory), f"link{os.getpid()}-")
        try:
            made.start()
            yield made
        finally:
            made.stop()


@contextmanager
def wire() -> Iterator[Wire]:
    """A started wire; everything is removed afterwards, also after a failure."""
    with _started(Wire, 2, 1) as made:
        yield made


@contextmanager
def laboratory(hosts: int = 2, *, seed: int = 1, link: Link | None = None) -> Iterator[Laboratory]:
    """A started laboratory; everything is removed afterwards, also after a failure."""
    with _started(Laboratory, hosts, seed) as made:
        made.become(link or Link())
        yield made


def _ip(*arguments: str) -> str:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise LaboratoryError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout
