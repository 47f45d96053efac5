"""Actions that the page may start with --allow-actions: meshctl's own commands, each prepared, shown, and confirmed.

`prepare` runs the command that changes nothing (`plan`, `--dry-run`); `confirm` carries out exactly what was shown if
the operator typed the device's name. A command runs as its own process, so a job survives neither more nor less than
the same command in a terminal: node locks, journal, commit-confirm and `meshctl resume` work as there.
"""

from __future__ import annotations

import hmac
import os
import secrets
import subprocess
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from meshctl.errors import InputError
from meshctl.report.terminal_escapes import clean

# A plan that was shown longer ago may no longer be what the operator has in mind.
CONFIRM_WITHIN_S = 600.0
MAX_OUTPUT = 200_000
MAX_JOBS = 100


@dataclass(slots=True)
class Job:
    """One command in progress or ended. `exit_code` is None while it runs; `is_confirmable` if `confirm` may follow."""

    id: str
    action: str
    device: str
    started_s: float
    output: str = ""
    exit_code: int | None = None
    is_confirmable: bool = False
    process: subprocess.Popen[str] | None = field(default=None, repr=False)

    def as_json(self) -> dict[str, Any]:
        return {
            "id": self.id,
            "action": self.action,
            "device": self.device,
            "output": self.output,
            "exit_code": self.exit_code,
            "is_confirmable": self.is_confirmable,
        }


class Actions:
    """Jobs by id. `command` is how meshctl is started, `options` are the inventory, keys and lab of this monitor."""

    def __init__(
        self,
        command: Sequence[str],
        options: Sequence[str],
        devices: Callable[[], frozenset[str]],
        directory: Path,
        clock: Callable[[], float],
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self._command = tuple(command)
        self._options = tuple(options)
        self._devices = devices
        self._directory = directory
        self._clock = clock
        self._on_change = on_change
        self._lock = threading.Lock()
        self._jobs: dict[str, Job] = {}

    def prepare(self, action: str, device: str) -> Job:
        """Show what the action would do. Raises InputError for an unknown action or device."""
        if device not in self._devices():
            raise InputError(f"the inventory has no managed radio {device!r}")
        number = secrets.token_urlsafe(12)
        words = self._words(action, device, number, is_preparation=True)
        job = Job(number, action, device, self._clock())
        self._keep(job)
        if words is None:
            job.output = (
                f"Reboots {device}. Robots that have no other path to the base lose it until the radio is back."
            )
            job.exit_code, job.is_confirmable = 0, True
        else:
            self._start(job, words, then=self._prepared)
        return job

    def confirm(self, number: str, confirmation: str) -> Job:
        """Carry out what was shown, once. Raises InputError if the device's name was not typed."""
        with self._lock:
            job = self._jobs.get(number)
            if job is None or not job.is_confirmable:
                raise InputError("nothing to confirm: prepare the action first")
            if not hmac.compare_digest(confirmation.encode(), job.device.encode()):
                raise InputError(f"not confirmed: expected the name {job.device}")
            job.is_confirmable = False
            if self._clock() - job.started_s > CONFIRM_WITHIN_S:
                raise InputError("not confirmed: this was shown too long ago, prepare the action again")
        words = self._words(job.action, job.device, number, is_preparation=False)
        assert words is not None, "every action has a command"
        done = Job(secrets.token_urlsafe(12), job.action, job.device, self._clock())
        self._keep(done)
        self._start(done, words, then=self._done)
        return done

    def job(self, number: str) -> Job:
        with self._lock:
            if number not in self._jobs:
                raise InputError(f"no job {number!r}")
            return self._jobs[number]

    def close(self) -> None:
        """Interrupt what still runs, as Ctrl-C does in a terminal, and wait for it."""
        with self._lock:
            running = [job.process for job in self._jobs.values() if job.process is not None and job.exit_code is None]
        for process in running:
            process.send_signal(2)
        for process in running:
            process.wait()

    def _plan_file(self, number: str) -> Path:
        return self._directory / f"plan-{number}.json"

    def _words(self, action: str, device: str, number: str, *, is_preparation: bool) -> tuple[str, ...] | None:
        """The command of an action; None if its preparation needs none."""
        plan = str(self._plan_file(number))
        match action, is_preparation:
            case "provision", True:
                return ("plan", device, "--out", plan)
            case "provision", False:
                return ("apply", plan)
            case "reboot", True:
                return None
            case "reboot", False:
                return ("run", device, "--", "(sleep 1; reboot) >/dev/null 2>&1 &")
            case "deployed", _:
                return ("deployed", device, *(("--dry-run",) if is_preparation else ()))
            case "carried", _:
                return ("deployed", device, "--back", *(("--dry-run",) if is_preparation else ()))
        raise InputError(f"expected an action (provision, reboot, deployed, carried), found {action!r}")

    def _start(self, job: Job, words: Sequence[str], then: Callable[[Job], None]) -> None:
        # options come before `--`
        at = words.index("--") if "--" in words else len(words)
        given = [*self._command, *words[:at], *self._options, *words[at:]]
        job.process = subprocess.Popen(
            given,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env={**os.environ, "NO_COLOR": "1", "COLUMNS": "100"},
            # Ctrl-C in the monitor's terminal is passed on by `close`, once
            start_new_session=True,
        )
        assert job.process.stdout is not None
        threading.Thread(
            target=self._follow, args=(job, job.process, job.process.stdout, then), name="action", daemon=True
        ).start()

    def _follow(self, job: Job, process: subprocess.Popen[str], output: IO[str], then: Callable[[Job], None]) -> None:
        with output:
            for line in output:
                job.output = (job.output + clean(line))[-MAX_OUTPUT:]
        code = process.wait()
        then_code = code if code >= 0 else 128 - code
        if then_code == 0:
            then(job)
        if not job.output:
            job.output = "done" if then_code == 0 else f"failed with exit code {then_code}"
        job.exit_code = then_code

    def _prepared(self, job: Job) -> None:
        job.is_confirmable = True

    def _done(self, job: Job) -> None:
        self._on_change()

    def _keep(self, job: Job) -> None:
        with self._lock:
            while len(self._jobs) >= MAX_JOBS:
                del self._jobs[next(iter(self._jobs))]
            self._jobs[job.id] = job
