"""Execute one run at its site, without the operator: `start` -> (detached) `execute` -> `meshctl apply` -> over.json.

The runner's process and that of `meshctl apply` inherit the site's lock, so it is held for as long as either of them
can change a node. Neither belongs to the session of the uplink, whose end they do not notice.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from meshctl.errors import InputError
from meshctl.fleet.process import process_of, this_process
from meshctl.sites.order import SignedOrder, checked_order, operator_keys
from meshctl.sites.part import FILES_VARIABLE
from meshctl.sites.runs import RunDirectory, SiteDirectory, closing, read_json, replace_text, write_json

_LAST_ERRORS_BYTES = 4096


def meshctl_command(*words: str) -> list[str]:
    """This very meshctl as a command."""
    return [sys.executable, "-P", "-m", "meshctl", *words]


def environment(directory: SiteDirectory, run: RunDirectory, environ: Mapping[str, str]) -> dict[str, str]:
    """The environment of a command at the site: a journal of its own, no agent that leaves with the uplink, and no
    settings of the gateway's user."""
    removed = ("SSH_AUTH_SOCK", "MESHCTL_INVENTORY", "MESHCTL_STORE", "COLUMNS")
    kept = {name: value for name, value in environ.items() if name not in removed}
    return {
        **kept,
        "XDG_STATE_HOME": str(directory.state),
        "MESHCTL_CONFIG": "",
        FILES_VARIABLE: str(run.inventory),
        "PYTHONUNBUFFERED": "1",
    }


def key_options(directory: SiteDirectory) -> list[str]:
    return ["--key", str(directory.key)] if directory.key.exists() else []


def start(directory: SiteDirectory, signed: SignedOrder, environ: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """Check an order and start its run, detached. Raises OrderRefused, SiteBusy, InputError."""
    order = checked_order(signed, operator_keys(directory.operators()), fleet=directory.fleet, site=directory.site)
    run = directory.run(order.run)
    if run.order.exists():
        raise InputError(f"run {order.run} has been started already", hint="run `meshctl resume` to see how it ended")
    if not run.inventory.exists():
        raise InputError(f"run {order.run} is not prepared at {directory.site}, or was too long ago: plan it again")
    if order.part_sha256 != run.part_sha256() or order.plan_sha256 != run.plan_sha256():
        raise InputError(f"run {order.run}: the order is for another plan than the one that was made here")
    holder = {"run": order.run, "operator": order.operator, "command": order.command, "since_s": time.time()}
    with closing(directory.lock(holder)) as lock:
        write_json(
            run.order, {"operator": order.operator, "command": order.command, "text": signed.text, "key": signed.key}
        )
        with run.errors.open("ab") as errors:
            runner = subprocess.Popen(
                meshctl_command("worker", f"{directory.fleet}/{directory.site}", "--execute", order.run),
                stdin=subprocess.DEVNULL,
                stdout=errors,
                stderr=errors,
                start_new_session=True,
                pass_fds=(lock,),
                env={**environ, "MESHCTL_SITE_LOCK": str(lock)},
            )
        # before the answer: who asks for the run's state next must not find it without a process
        replace_text(run.process, f"{process_of(runner.pid)}\n")
    return runner


def execute(directory: SiteDirectory, run: RunDirectory, environ: Mapping[str, str]) -> int:
    """Apply the plan of a started run and record how it ended; returns the exit status of `meshctl apply`."""
    lock = int(environ.get("MESHCTL_SITE_LOCK", "-1"))
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # `stop` speaks to the command below; the runner has to record its end
        signal.signal(number, signal.SIG_IGN)
    order = read_json(run.order)
    with run.events.open("ab") as events, run.errors.open("ab") as errors:
        child = subprocess.Popen(
            _apply_command(directory, run, str(order.get("text", ""))),
            stdin=subprocess.DEVNULL,
            stdout=events,
            stderr=errors,
            start_new_session=True,
            pass_fds=(lock,) if lock >= 0 else (),
            env=environment(directory, run, environ),
            # an ignored signal would stay ignored there
            preexec_fn=_default_signals,
        )
        # a file of its own: the one above may be written later
        replace_text(run.processes, f"{this_process()}\n{process_of(child.pid)}\n")
        status = child.wait()
    error, hint = _last_error(run.errors)
    write_json(run.over, {"exit": status, "error": error, "hint": hint, "ended_s": time.time()})
    run.forget_secrets()
    return status


def _default_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def _apply_command(directory: SiteDirectory, run: RunDirectory, order: str) -> list[str]:
    rate = json.loads(order).get("rate_kb_s") if order else None
    rate_options = [] if rate is None else ["--rate", str(rate)]
    options = ["-i", str(run.inventory), "--json", *rate_options, *key_options(directory)]
    return meshctl_command("apply", str(run.plan), *options)


def _last_error(path: Path) -> tuple[str, str]:
    """The last error and its hint in what the command said on its error output."""
    try:
        text = path.read_bytes()[-_LAST_ERRORS_BYTES:].decode("utf-8", "replace")
    except OSError:
        return "", ""
    error = hint = ""
    for line in text.splitlines():
        if line.startswith("error: "):
            error, hint = line.removeprefix("error: "), ""
        elif line.startswith("hint: "):
            hint = line.removeprefix("hint: ")
    return error, hint


def stop(run: RunDirectory) -> bool:
    """Ask the run to finish the nodes in progress and to start no more; whether it is in progress."""
    lines = run.processes.read_text(encoding="utf-8").splitlines() if run.processes.exists() else []
    if not run.is_alive() or len(lines) < 2:
        return False
    try:
        os.kill(int(lines[1].split(":")[1]), signal.SIGINT)
    except (ProcessLookupError, ValueError, IndexError):
        return False
    return True
