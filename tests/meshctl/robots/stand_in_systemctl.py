"""A stand-in for `systemctl` where pid 1 is no systemd: one unit, really started, watched and restarted.

It does what the scripts on a robot rely on: `Type=notify` (start waits for READY=1 on $NOTIFY_SOCKET), `User=`, runtime
and state directories, `Restart=always`, enable and disable as links, stop by SIGTERM. It knows neither sandboxing nor
the watchdog nor the journal: the daemon's output goes to a file that the stand-in `journalctl` prints. Standard library
only; runs inside the machine that tests/meshctl/robots/machine.py makes.
"""

from __future__ import annotations

import fcntl
import os
import pwd
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

UNITS = Path("/etc/systemd/system")
WANTS = UNITS / "multi-user.target.wants"
STATE = Path("/run/stand-in")
LOG = STATE / "log"
WAIT_S = 120.0
"""Longer than any start on a busy machine."""


def main(words: list[str]) -> int:
    STATE.mkdir(exist_ok=True)
    options = [word for word in words if word.startswith("-")]
    verb, *units = [word for word in words if not word.startswith("-")]
    unit = units[0] if units else ""
    match verb:
        case "daemon-reload" | "reset-failed":
            return 0
        case "is-active":
            state = read(unit)
            say("activating" if state == "auto-restart" else state)
            return 0 if state == "active" else 3
        case "is-enabled":
            found = "enabled" if (WANTS / unit).is_symlink() else "disabled" if (UNITS / unit).exists() else "not-found"
            say(found)
            return 0 if found == "enabled" else 1
        case "enable":
            WANTS.mkdir(parents=True, exist_ok=True)
            (WANTS / unit).unlink(missing_ok=True)
            (WANTS / unit).symlink_to(UNITS / unit)
            return 0
        case "disable":
            (WANTS / unit).unlink(missing_ok=True)
            return stop(unit) if "--now" in options else 0
        case "start":
            return start(unit)
        case "stop":
            return stop(unit)
        case "restart":
            stop(unit)
            return start(unit)
        case "supervise":
            return supervise(unit)
        case _:
            sys.stderr.write(f"stand-in: no verb {verb}\n")
            return 1


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def read(unit: str) -> str:
    """`active`, `auto-restart`, `starting` or `inactive`; whoever supervises holds the lock as long as it lives."""
    try:
        with (STATE / f"{unit}.lock").open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return (STATE / f"{unit}.state").read_text() or "starting"
    except FileNotFoundError:
        pass
    return "inactive"


def write(unit: str, state: str) -> None:
    partial = STATE / f"{unit}.state.new"
    partial.write_text(state)
    partial.replace(STATE / f"{unit}.state")


def wait(what: str, unit: str, wanted: tuple[str, ...]) -> str:
    deadline = time.monotonic() + WAIT_S
    while (state := read(unit)) not in wanted:
        if time.monotonic() > deadline:
            raise SystemExit(f"stand-in: {unit} did not {what}: {state}")
        time.sleep(0.05)
    return state


def start(unit: str) -> int:
    if not (UNITS / unit).exists():
        sys.stderr.write(f"Unit {unit} not found.\n")
        return 5
    if read(unit) == "active":
        return 0
    write(unit, "starting")
    with LOG.open("ab") as log:
        subprocess.Popen(
            [sys.executable, __file__, "supervise", unit],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            cwd="/",
        )
    return 0 if wait("start", unit, ("active", "auto-restart")) == "active" else 1


def stop(unit: str) -> int:
    if read(unit) != "inactive":
        os.kill(int((STATE / f"{unit}.pid").read_text()), signal.SIGTERM)
        wait("stop", unit, ("inactive",))
    return 0


def settings(unit: str) -> dict[str, str]:
    lines = [line.partition("=") for line in (UNITS / unit).read_text().splitlines() if not line.startswith(("#", "["))]
    return {name: value for name, equals, value in lines if equals}


def supervise(unit: str) -> int:
    """Runs the unit's program, again whenever it ends, until SIGTERM."""
    stopping = False

    def on_term(number: int, frame: object) -> None:
        nonlocal stopping
        stopping = True

    signal.signal(signal.SIGTERM, on_term)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with (STATE / f"{unit}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (STATE / f"{unit}.pid").write_text(str(os.getpid()))
        told = settings(unit)
        user = pwd.getpwnam(told["User"])
        for parent, name in (("/run", told["RuntimeDirectory"]), ("/var/lib", told["StateDirectory"])):
            path = Path(parent, name)
            path.mkdir(exist_ok=True)
            os.chown(path, user.pw_uid, user.pw_gid)
        address = STATE / f"{unit}.notify"
        while not stopping:
            address.unlink(missing_ok=True)
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
                notify.bind(str(address))
                address.chmod(0o777)
                notify.settimeout(0.1)
                process = subprocess.Popen(
                    shlex.split(told["ExecStart"]),
                    stdin=subprocess.DEVNULL,
                    env={"PATH": "/usr/bin:/bin", "NOTIFY_SOCKET": str(address)},
                    cwd="/",
                    user=user.pw_uid,
                    group=user.pw_gid,
                    extra_groups=[],
                )
                while process.poll() is None and not stopping:
                    try:
                        if b"READY=1" in notify.recv(4096):
                            write(unit, "active")
                    except TimeoutError:
                        continue
                if process.poll() is None:
                    process.terminate()
                process.wait()
            if not stopping:
                write(unit, "auto-restart")
                say(f"{unit}: ended with status {process.returncode}; starting it again")
                time.sleep(float(told["RestartSec"]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
