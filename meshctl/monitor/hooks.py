"""Report new alarms to other programs: a webhook and a command, in a thread of their own.

`AlarmHooks.notify` never blocks: alarms wait in a bounded queue, and the oldest are dropped if a hook cannot follow.
Text from a device reaches a hook as JSON and as environment variables, never as part of a command line.
"""

from __future__ import annotations

import http.client
import json
import os
import signal
import subprocess
import threading
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from meshctl import event_log
from meshctl.errors import InputError
from meshctl.monitor.access import TOKEN_VARIABLE
from meshctl.monitor.alarm_log import LEVELS, LoggedAlarm

# Of one call; a hook that is slower is given up.
TIMEOUT_S = 10.0
# Alarms of a fleet that breaks down at once, with a few minutes for them at the timeout.
MAX_WAITING = 100
# A device's text in an environment variable.
MAX_TEXT = 1000


@dataclass(frozen=True, slots=True)
class HookSettings:
    """Where to report alarms. `command` is a program and its arguments; `min_level` one of `alarm_log.LEVELS`."""

    webhook: str = ""
    command: tuple[str, ...] = ()
    min_level: str = "warning"
    timeout_s: float = TIMEOUT_S

    def __post_init__(self) -> None:
        """Raises InputError for what is no URL or no level."""
        if self.min_level not in LEVELS:
            raise InputError(f"hook level: expected {', '.join(LEVELS)}, found {self.min_level!r}")
        if self.webhook and not _is_url(self.webhook):
            raise InputError(f"webhook: expected an http or https URL, found {self.webhook!r}")


def _is_url(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        return False


@dataclass(slots=True)
class AlarmHooks:
    """The hooks and their thread. `problem` says why the last call failed, also to `on_problem`; `dropped` counts
    alarms that were never reported."""

    settings: HookSettings
    fleet: str = ""
    on_problem: Callable[[str], None] = lambda text: None
    problem: str = ""
    dropped: int = 0
    _waiting: deque[LoggedAlarm] = field(default_factory=deque, repr=False)
    _wake: threading.Condition = field(default_factory=threading.Condition, repr=False)
    _is_busy: bool = False
    _is_closed: bool = False
    _thread: threading.Thread | None = field(default=None, repr=False)

    def notify(self, alarms: Sequence[LoggedAlarm]) -> None:
        """Report alarms that began; those that are silenced or below the level are left out. Returns at once."""
        if not self.settings.webhook and not self.settings.command:
            return
        least = LEVELS.index(self.settings.min_level)
        loud = [alarm for alarm in alarms if LEVELS.index(alarm.level) >= least and alarm.silenced is None]
        if not loud:
            return
        with self._wake:
            if self._is_closed:
                return
            self._waiting.extend(loud)
            while len(self._waiting) > MAX_WAITING:
                self._waiting.popleft()
                self.dropped += 1
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="alarm-hooks", daemon=True)
                self._thread.start()
            self._wake.notify_all()

    def close(self, timeout_s: float = 0.0) -> None:
        """Stop; alarms that still wait are given this time."""
        with self._wake:
            self._wake.wait_for(lambda: not self._waiting and not self._is_busy, timeout_s)
            self._is_closed = True
            self._wake.notify_all()

    def _work(self) -> None:
        while True:
            with self._wake:
                self._is_busy = False
                self._wake.notify_all()
                self._wake.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    return
                alarm = self._waiting.popleft()
                self._is_busy = True
            self._call(alarm)

    def _call(self, alarm: LoggedAlarm) -> None:
        document = {"fleet": self.fleet, **alarm.as_json()}
        problems = []
        if self.settings.webhook:
            problems.append(_post(self.settings.webhook, document, self.settings.timeout_s))
        if self.settings.command:
            problems.append(_run(self.settings.command, document, self.settings.timeout_s))
        self.problem = "; ".join(problem for problem in problems if problem)
        if self.problem:
            event_log.emit(event_log.INFO, "hook failed", device=alarm.device, code=alarm.code, reason=self.problem)
            self.on_problem(f"alarm not reported: {self.problem}")


def _post(url: str, document: Mapping[str, Any], timeout_s: float) -> str:
    """POST the alarm; what went wrong, empty if nothing. The whole exchange is bounded, not only each read."""
    failure: list[str] = []
    no_response = f"webhook {url}: no response within {timeout_s:g} s"

    def send() -> None:
        body = json.dumps(document).encode()
        request = urllib.request.Request(url, body, {"Content-Type": "application/json", "User-Agent": "meshctl"})
        try:
            with urllib.request.build_opener(_NoRedirect).open(request, timeout=timeout_s) as response:
                response.read(1)
        except urllib.error.HTTPError as error:
            failure.append(f"webhook {url}: {error.code} {error.reason}")
        except (OSError, ValueError, http.client.HTTPException) as error:
            reason = getattr(error, "reason", None) or error
            # A read may reach its own timeout before the whole exchange does.
            failure.append(no_response if isinstance(reason, TimeoutError) else f"webhook {url}: {reason}")

    thread = threading.Thread(target=send, name="webhook", daemon=True)
    thread.start()
    thread.join(timeout_s)
    return no_response if thread.is_alive() else "".join(failure)


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """An alarm goes where the operator said, and to no other scheme or host."""

    def redirect_request(self, *arguments: Any, **options: Any) -> None:
        return None


def _run(command: Sequence[str], document: Mapping[str, Any], timeout_s: float) -> str:
    """Run the command with the alarm on its standard input; what went wrong, empty if nothing. No shell is involved."""
    try:
        process = subprocess.Popen(
            list(command),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**_inherited(), **_environment(document)},
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        return f"command {command[0]}: {error}"
    try:
        process.communicate(json.dumps(document).encode(), timeout_s)
    except subprocess.TimeoutExpired:
        # with the processes that it started
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=1.0)
        return f"command {command[0]}: did not end within {timeout_s:g} s"
    return f"command {command[0]}: exit status {process.returncode}" if process.returncode else ""


def _inherited() -> dict[str, str]:
    """The environment without the token, which is for browsers."""
    return {name: value for name, value in os.environ.items() if name != TOKEN_VARIABLE}


def _environment(document: Mapping[str, Any]) -> dict[str, str]:
    """The alarm as variables, without control characters."""
    values = {}
    for key in ("fleet", "device", "code", "level", "text", "hint"):
        text = "".join(character if character.isprintable() else " " for character in str(document.get(key) or ""))
        values[f"MESHCTL_ALARM_{key.upper()}"] = text.encode("utf-8", "replace").decode()[:MAX_TEXT]
    return values
