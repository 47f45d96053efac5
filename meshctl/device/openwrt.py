"""OpenWrt operations on a node: uptime, files, backup, firmware, reload, reboot.

Each runs one short script over a `Connection`, with absolute paths of the tools that change something. Actions
that end the connection (reboot, sysupgrade) start as a detached process after a delay, so that the answer arrives.
"""

from __future__ import annotations

import io
import json
import re
import tarfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from meshctl.device.connection import Connection
from meshctl.device.errors import CommandFailed
from meshctl.device.framing import quoted
from meshctl.device.parse.jsontext import boolean, mapping, parse_json
from meshctl.device.parse.system import parse_boot_id, parse_meminfo, parse_uptime

# `sysupgrade -T` unpacks and hashes the image.
FIRMWARE_TEST_TIMEOUT_S = 120.0
UPGRADE_STATE_TIMEOUT_S = 60.0
_PATTERN = re.compile(r"/[A-Za-z0-9._/+@*?-]+")
# sysupgrade's own lines have the date before them from 21.02 on (lib/upgrade/common.sh, v).
_STAMP = re.compile(r"^.{,60} upgrade: ")
# sysupgrade's advice to flash a rejected image anyway
_FORCE_ADVICE = "Use sysupgrade -F"
# Delay before a detached process acts, so that the answer arrives.
DETACHED_DELAY_S = 1


@dataclass(frozen=True, slots=True)
class UptimeSample:
    """The node's uptime at `at_s` of the observer's monotonic clock, to within `error_s` on either side."""

    boot_id: str
    uptime_s: float
    at_s: float
    error_s: float

    def uptime_at(self, now_s: float) -> float:
        """The node's uptime at `now_s` of the observer's monotonic clock."""
        return self.uptime_s + now_s - self.at_s


def measure_uptime(
    connection: Connection, *, samples: int = 3, monotonic: Callable[[], float] = time.monotonic
) -> UptimeSample:
    """Measure the node's uptime against our clock; half of the shortest round trip bounds the error.

    A simultaneous change is scheduled by it; the node's wall clock is not used.
    """
    best: UptimeSample | None = None
    for _ in range(max(samples, 1)):
        asked = monotonic()
        done = connection.run("cat /proc/uptime /proc/sys/kernel/random/boot_id")
        answered = monotonic()
        lines = done.check(f"{connection.endpoint.label}: read the uptime").stdout.splitlines()
        uptime = parse_uptime(lines[0]) if lines else None
        boot_id = parse_boot_id(lines[1]) if len(lines) > 1 else None
        if uptime is None or boot_id is None:
            raise CommandFailed(f"{connection.endpoint.label}: no uptime or boot id in {lines!r}", exit_status=0)
        sample = UptimeSample(boot_id, uptime, (asked + answered) / 2, (answered - asked) / 2)
        best = sample if best is None or sample.error_s < best.error_s else best
    assert best is not None
    return best


@dataclass(frozen=True, slots=True)
class FetchedFile:
    """A file on the node."""

    content: bytes = field(repr=False)
    mode: int


def fetch_files(connection: Connection, paths: Iterable[str]) -> dict[str, FetchedFile]:
    """The regular files among `paths` (shell patterns are expanded on the node), in one round trip."""
    wanted = tuple(paths)
    for path in wanted:
        if not _PATTERN.fullmatch(path):
            raise ValueError(f"{path!r}: expected an absolute path without blanks or quotes")
    words = " ".join(path.lstrip("/") for path in wanted)
    # a pattern without a match stays as it is, so only existing files are passed to tar
    script = f'cd / || exit 1; set --; for f in {words}; do [ ! -f "$f" ] || set -- "$@" "$f"; done\n'
    script += 'if [ $# -gt 0 ]; then tar -cf - "$@"; fi'
    done = connection.run(script).check(f"{connection.endpoint.label}: read files")
    if not done.stdout_bytes:
        return {}
    found: dict[str, FetchedFile] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(done.stdout_bytes)) as archive:
            for member in archive:
                file = archive.extractfile(member)
                if file is not None:
                    found["/" + member.name.lstrip("/")] = FetchedFile(file.read(), member.mode & 0o7777)
    except tarfile.TarError as error:
        raise CommandFailed(
            f"{connection.endpoint.label}: an archive that cannot be read: {error}", exit_status=0
        ) from error
    return found


def backup(connection: Connection) -> bytes:
    """The node's configuration backup (`sysupgrade -b`), a tar.gz."""
    script = (
        "umask 077; mkdir -p /tmp/meshctl; b=/tmp/meshctl/backup.$$\n"
        '/sbin/sysupgrade -b "$b" >/dev/null && cat "$b"; s=$?; rm -f "$b"; exit $s'
    )
    return connection.run(script).check(f"{connection.endpoint.label}: back up").stdout_bytes


def is_first_boot(connection: Connection) -> bool:
    """Whether the first boot after a flash has not ended.

    Until then / is in memory, if its flash has to be formatted (fstools, overlay.c), or each boot unpacks the archive
    that the flash kept, which the last init script deletes (base-files, 80_mount_root and etc/init.d/done).
    """
    script = "[ -e /sysupgrade.tgz ] || grep -q '^overlayfs:/tmp/root / ' /proc/mounts"
    return connection.run(script).exit_status == 0


@dataclass(frozen=True, slots=True)
class FirmwareCheck:
    """The node's verdict on an image: `valid`, with `tests` and `reason`."""

    valid: bool
    reason: str
    tests: Mapping[str, bool]
    available_bytes: int | None


def check_firmware(connection: Connection, image_path: str) -> FirmwareCheck:
    """Run `sysupgrade -T` and, where procd has it, `validate_firmware_image` on an uploaded image.

    Also drops caches and reports the memory then available, which sysupgrade does not check.
    """
    request = quoted(json.dumps({"path": image_path}))
    script = (
        "/bin/sync; echo 3 2>/dev/null >/proc/sys/vm/drop_caches\n"
        # with -n, as for the flash itself: without, it rejects an image of another minor compat_version
        f'/sbin/sysupgrade -T -n {quoted(image_path)} >/tmp/sysupgrade.test 2>&1; echo "status $?"\n'
        "sed 's/^/said /' /tmp/sysupgrade.test; rm -f /tmp/sysupgrade.test\n"
        f"ubus call system validate_firmware_image {request} 2>/dev/null | tr -d '\\n\\t' | sed 's/^/json /'; echo\n"
        "cat /proc/meminfo"
    )
    done = connection.run(script, timeout_s=FIRMWARE_TEST_TIMEOUT_S)
    lines = done.check(f"{connection.endpoint.label}: test the firmware").stdout.splitlines()
    output = [_STAMP.sub("", line[5:]).strip().rstrip(".") for line in lines if line.startswith("said ")]
    validation = mapping(parse_json(next((line[5:] for line in lines if line.startswith("json ")), "")))
    memory = parse_meminfo(done.stdout)
    # procd rejects `-f` for such an image only after `sysupgrade` has started; -T does not check it
    bare = validation.get("allow_backup") is False
    passed = "status 0" in lines and (not validation or boolean(validation.get("valid"))) and not bare
    reason = "; ".join(line for line in output if line and not line.startswith(_FORCE_ADVICE)) or "sysupgrade -T failed"
    if bare:
        reason = "it does not accept a configuration from the running system"
    return FirmwareCheck(
        valid=passed,
        reason="" if passed else reason,
        tests={name: boolean(value) for name, value in mapping(validation.get("tests")).items()},
        available_bytes=None if memory is None else memory.available,
    )


def start_sysupgrade(connection: Connection, image_path: str, config_path: str) -> None:
    """Flash the image with only the configuration in the tar.gz at `config_path` (`sysupgrade -n -f`), detached.

    Returns once it is started; the connection will break. Only a new boot id, the expected revision and the marker in
    the flashed configuration prove success.
    """
    act = f"exec /sbin/sysupgrade -n -f {quoted(config_path)} {quoted(image_path)} >/tmp/sysupgrade.log 2>&1"
    _detached(connection, "sysupgrade", act)


class Upgrade(Enum):
    """State of a `sysupgrade` that was started, on a node that still runs the previous firmware."""

    NOT_STARTED = "not started"
    RUNNING = "running"
    ENDED = "ended"


def upgrade_state(connection: Connection) -> tuple[Upgrade, str]:
    """The state of the `sysupgrade` that `start_sysupgrade` started, and the last that it said.

    It is not over when its script is: procd tests the image once more and answers no request meanwhile, while
    `ubus call` waits 30 s for it (ubus, cli.c). Then procd becomes `upgraded`, which writes the flash (procd,
    sysupgrade.c). If procd answers a later request, it has refused the upgrade.
    """
    script = (
        f"pid=''; read -r pid 2>/dev/null <{_pid_file('sysupgrade')}\n"
        'if [ -z "$pid" ]; then echo "not started"\n'
        'elif grep -q sysupgrade "/proc/$pid/cmdline" 2>/dev/null; then echo running\n'
        "elif ubus call system board >/dev/null 2>&1 && ! grep -q '^upgraded$' /proc/1/comm; then echo ended\n"
        "else echo running; fi\n"
        "tail -n 3 /tmp/sysupgrade.log 2>/dev/null"
    )
    done = connection.run(script, timeout_s=UPGRADE_STATE_TIMEOUT_S)
    state, *output = done.stdout.splitlines() or [Upgrade.RUNNING.value]
    lines = (_STAMP.sub("", line).strip() for line in output)
    return Upgrade(state), "; ".join(line for line in lines if line)


def _pid_file(name: str) -> str:
    return f"/tmp/meshctl/{name}.pid"


def _detached(connection: Connection, name: str, act: str) -> None:
    # with a fresh pid file, because -x alone would match any running shell and start nothing
    pid_file = _pid_file(name)
    daemon = quoted(f"sleep {DETACHED_DELAY_S}; {act}")
    start = f"start-stop-daemon -S -b -m -p {pid_file} -x /bin/sh -- -c {daemon}"
    started = f"mkdir -p /tmp/meshctl && rm -f {pid_file} && {start}"
    connection.run(started).check(f"{connection.endpoint.label}: start {name}")
