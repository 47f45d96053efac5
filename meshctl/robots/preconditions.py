"""Preconditions of a deploy: the probe's output -> `HostFacts` -> all unmet preconditions, before any change. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from meshctl.errors import InputError
from meshctl.model import Computer, Fleet
from meshctl.report.duration import duration
from meshctl.resolve import computer_gateway, has_routed_lans
from meshctl.robots.wheel_tags import Target

# udp_mesh uses asyncio.timeout and tomllib.
MIN_PYTHON = (3, 11)
# A larger offset means a dead clock battery.
MAX_CLOCK_SKEW_S = 24 * 3600.0
# Free space to leave for other programs while a release is unpacked.
HEADROOM_KIB = 32 << 10


@dataclass(frozen=True, slots=True)
class HostFacts:
    """`files` are (path, hash) of the current release's manifest; `damaged` are paths that no longer match; `releases`
    and `trees` are the intact ones; `python` is None if none runs; `no_route` are peers' addresses without a route."""

    arch: str = ""
    now_s: float = 0.0
    uid: int = -1
    has_systemd: bool = False
    missing_tools: tuple[str, ...] = ()
    missing_ros: str = ""
    python: tuple[int, int, int] | None = None
    implementation: str = ""
    bits: int = 0
    libc: str = ""
    libc_version: tuple[int, int] = (0, 0)
    executable: str = ""
    missing_modules: tuple[str, ...] = ()
    free_kib: int = 0
    is_writable: bool = False
    runs_programs: bool = True
    current: str = ""
    previous: str = ""
    releases: tuple[str, ...] = ()
    trees: tuple[str, ...] = ()
    files: tuple[tuple[str, str], ...] = ()
    damaged: tuple[str, ...] = ()
    is_proven: bool = True
    services: tuple[tuple[str, str, str], ...] = ()
    no_route: tuple[str, ...] = ()
    has_ssh: bool = True
    port: int = 0
    """The daemon's UDP port in the current release; 0 without one."""

    @property
    def units(self) -> tuple[tuple[str, str, str], ...]:
        """(unit, active, enabled) of the current release's units, the daemon first."""
        ours = {path for path, _ in self.files}
        return tuple(service for service in self.services if service[0] in ours)

    @property
    def target(self) -> Target | None:
        """The wheel target; None if no Python runs."""
        if self.python is None:
            return None
        return Target(self.python[:2], _arch_of_python(self.arch, self.bits), self.libc, self.libc_version)

    @property
    def runs(self) -> bool:
        """Whether all its units are active and enabled."""
        return bool(self.units) and all(tuple(state) == ("active", "enabled") for _, *state in self.units)

    @property
    def masked(self) -> tuple[str, ...]:
        """Masked units (`systemctl mask`)."""
        return tuple(unit for unit, _, enabled in self.services if enabled.startswith("masked"))

    @property
    def is_sound(self) -> bool:
        """Whether the current release runs, is proven, and is intact on disk."""
        return self.is_proven and not self.damaged and self.runs


def parse_facts(text: str) -> HostFacts:
    """Parse the output of `scripts/probe.sh`; unknown lines are ignored."""
    value_of: dict[str, str] = {}
    many: dict[str, list[str]] = {}
    for line in text.splitlines():
        name, equals, value = line.partition("=")
        if equals:
            value_of[name] = value
            many.setdefault(name, []).append(value)
    libc, libc_version = _libc(value_of.get("libc", ""))
    return HostFacts(
        arch=value_of.get("arch", ""),
        now_s=float(_number(value_of.get("now", ""))),
        uid=_number(value_of.get("uid", "-1"), -1),
        has_systemd=value_of.get("systemd") == "yes",
        missing_tools=tuple(value_of.get("missing", "").split()),
        missing_ros=value_of.get("no_ros", ""),
        python=_version(value_of.get("python", "")),
        implementation=value_of.get("implementation", ""),
        bits=_number(value_of.get("bits", "")),
        libc=libc,
        libc_version=libc_version,
        executable=value_of.get("executable", ""),
        missing_modules=tuple(many.get("no_module", ())),
        free_kib=_number(value_of.get("free_kib", "")),
        is_writable=value_of.get("writable") == "yes",
        runs_programs=value_of.get("noexec") != "yes",
        current=value_of.get("current", ""),
        previous=value_of.get("previous", ""),
        releases=tuple(many.get("release", ())),
        trees=tuple(many.get("tree", ())),
        files=tuple((path, digest) for digest, _, path in (row.partition("  ") for row in many.get("file", ()))),
        damaged=tuple(many.get("damaged", ())),
        is_proven=value_of.get("proven") == "yes",
        services=tuple(_service(row) for row in many.get("unit", ())),
        no_route=tuple(many.get("no_route", ())),
        has_ssh="no_ssh" not in value_of,
        port=_number(value_of.get("port", "")),
    )


def _service(row: str) -> tuple[str, str, str]:
    """`NAME ACTIVE ENABLED`; the latter are empty for unknown units."""
    name, active, enabled, *_ = (*row.split(), "", "", "")
    return name, active, enabled


def _number(text: str, default: int = 0) -> int:
    return int(text) if re.fullmatch(r"-?\d+", text) else default


def _version(text: str) -> tuple[int, int, int] | None:
    found = re.fullmatch(r"(\d+)\.(\d+)\.(\d+)", text)
    return (int(found[1]), int(found[2]), int(found[3])) if found else None


def _libc(text: str) -> tuple[str, tuple[int, int]]:
    """`glibc 2.36`; platform.libc_ver returns nothing for musl before Python 3.13."""
    found = re.fullmatch(r"(glibc|musl) ?(\d+)\.(\d+).*", text)
    return (found[1], (int(found[2]), int(found[3]))) if found else ("musl", (1, 2))


def _arch_of_python(machine: str, bits: int) -> str:
    """The architecture in wheel tags: a 32-bit system may run on a 64-bit kernel (Raspberry Pi OS)."""
    if bits == 32:
        return {"x86_64": "i686", "aarch64": "armv7l"}.get(machine, machine)
    return machine


def computer_of(fleet: Fleet, robot: str) -> Computer:
    """The robot's computer. Raises InputError if it has none."""
    computer = fleet.robots[robot].computer
    if computer is None:
        raise InputError(f"robot {robot} has no computer in the inventory", hint=f"set robots.{robot}.computer")
    return computer


def clock_warning(facts: HostFacts, now_s: float) -> tuple[str, str]:
    """(what is wrong with its clock, how to fix it), or empty strings.

    A wrong clock does not affect deploys or the daemon, but it makes logs and recordings wrong.
    """
    skew_s = facts.now_s - now_s
    if abs(skew_s) <= MAX_CLOCK_SKEW_S:
        return "", ""
    side = "ahead of" if skew_s > 0 else "behind"
    return (
        f"its clock is {duration(abs(skew_s))} {side} ours",
        "set it with `date -s` or NTP; until then log times are wrong",
    )


def routed_peers(fleet: Fleet, robot: str) -> dict[str, str]:
    """The computers' addresses outside the network of the robot's computer, and their robots' names.

    None without routed LANs: separate meshes need no routes to each other.
    """
    if not has_routed_lans(fleet):
        return {}
    network = computer_of(fleet, robot).address.network
    computers = ((peer.name, peer.computer) for peer in fleet.robots.values() if peer.computer is not None)
    return {str(other.address.ip): name for name, other in computers if other.address.ip not in network}


def route_warning(facts: HostFacts, fleet: Fleet, robot: str) -> tuple[str, str]:
    """(which peers its computer has no route to, how to add them), or empty strings."""
    names = routed_peers(fleet, robot)
    missing = [f"{names[address]} ({address})" for address in facts.no_route if address in names]
    if not missing:
        return "", ""
    gateway = computer_gateway(fleet, fleet.robots[robot])
    hint = f"set a permanent route through {gateway} there, as `ip route add default via {gateway}` does until a reboot"
    return f"it has no route to {', '.join(missing)}", hint if gateway is not None else ""


def unmet_preconditions(facts: HostFacts, *, robot: str, arch: str, python: str) -> Iterator[tuple[str, str]]:
    """Why the computer cannot run udp_mesh with the inventory's `arch` and `python`: (reason, how to fix it)."""
    if facts.uid != 0:
        yield "the scripts did not run as root", "log in as root, or as a user with sudo rights"
    if not facts.has_systemd:
        yield "systemd is not running", "udp_mesh is deployed as a systemd service"
    if facts.missing_tools:
        yield f"missing tools: {', '.join(facts.missing_tools)}", "install coreutils, util-linux, tar and mawk"
    if facts.missing_ros:
        hint = f"install ROS there, or remove `ros` from robots.{robot}.computer"
        yield f"ROS is not installed: {facts.missing_ros} is missing", hint
    if facts.arch != arch:
        hint = f"if it is the right computer, set `arch: {facts.arch}` in robots.{robot}.computer"
        yield f"wrong CPU: expected {arch}, found {facts.arch}", hint
    yield from _unmet_python(facts, robot, python)
    if not facts.is_writable:
        yield "its disk is read-only", "remount it, or check its log for disk errors"
    if not facts.runs_programs:
        yield "/opt is mounted noexec", "remount it with exec, and fix /etc/fstab"
    if facts.masked:
        hint = f"find out why, then run `systemctl unmask {' '.join(facts.masked)}` there"
        yield f"masked units: {', '.join(facts.masked)}", hint


def unmet_for_collector(
    facts: HostFacts, *, robot: str, radios: Sequence[str], without_pin: Sequence[str]
) -> Iterator[tuple[str, str]]:
    """Why the computer cannot run a collector for these radios: (reason, how to fix it)."""
    otherwise = f"remove `collector` from robots.{robot}.computer"
    if not radios:
        yield "its collector has no radio to ask", f"name the robot's radios in robots.{robot}.nodes, or {otherwise}"
    if not facts.has_ssh:
        yield "its collector needs ssh and ssh-keygen", f"install openssh-client there, or {otherwise}"
    if without_pin:
        names = " ".join(without_pin)
        yield f"no host key is pinned of its radios {', '.join(without_pin)}", f"run `meshctl trust {names}`"


def _unmet_python(facts: HostFacts, robot: str, python: str) -> Iterator[tuple[str, str]]:
    minimum = ".".join(map(str, MIN_PYTHON))
    name_it = f"install Python {minimum} or newer and set robots.{robot}.computer.python"
    if facts.python is None:
        yield f"{python} does not run", name_it
        return
    found = ".".join(map(str, facts.python))
    if facts.python[:2] < MIN_PYTHON:
        yield f"wrong Python: {python} is {found}, expected {minimum} or newer", name_it
    if facts.implementation != "CPython":
        yield f"wrong Python: {python} is {facts.implementation}, expected CPython", name_it
    if facts.missing_modules:
        lacking = ", ".join(facts.missing_modules)
        yield (
            f"{python} lacks the standard modules {lacking}",
            "install the full Python (python3, not python3-minimal)",
        )


def unmet_disk_space(facts: HostFacts, needed_bytes: int) -> Iterator[tuple[str, str]]:
    """The reason if a release of that size does not fit on the disk."""
    needed_kib = needed_bytes // 1024 + HEADROOM_KIB
    if facts.free_kib < needed_kib:
        found = f"found {facts.free_kib >> 10} MiB free"
        yield f"disk full: expected {(needed_kib >> 10) + 1} MiB in /opt, {found}", "free disk space there"


def changed_files(facts: HostFacts, desired: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    """Paths whose hash differs between the current release and a desired manifest, in manifest order."""
    here = dict(facts.files)
    desired = tuple(desired)
    gone = [path for path in here if path not in dict(desired)]
    return (*(path for path, digest in desired if here.get(path) != digest), *gone)
