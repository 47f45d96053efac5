"""`meshctl alarms`: the alarm log of a monitored fleet. Needs no device: it reads and writes the monitor's history."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import AsJson, InventoryPath, Lab
from meshctl.cli.monitor_history import HistoryFile, history_path
from meshctl.cli.output import echo, echo_error, echo_json
from meshctl.errors import ExitCode, InputError
from meshctl.fleet.process import owner
from meshctl.monitor.alarm_log import FLEET, LoggedAlarm, Silence
from meshctl.monitor.history_file import ANY
from meshctl.monitor.store import FrameStore
from meshctl.report.duration import duration
from meshctl.status.alarm_codes import CODES
from meshctl.suggest import did_you_mean

app = typer.Typer(help="List, acknowledge and silence the alarms that `meshctl monitor` records.", no_args_is_help=True)

_UNITS_S = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_FLEET_WORD = "fleet"

Device = Annotated[
    str, typer.Argument(help="A radio's name, robot:NAME for a robot's computer, `fleet` for the whole fleet.")
]
Code = Annotated[str, typer.Argument(help="The alarm's code, as `meshctl alarms list` shows it.")]
By = Annotated[str | None, typer.Option("--by", help="Operator to record; default: you.")]


@contextmanager
def _history(
    inventory: Path, lab: Path | None, store: Path | None, *, changes_nothing: bool = False
) -> Iterator[FrameStore]:
    if store is not None:
        with FrameStore.open_running(store) as opened:
            yield opened
        return
    from meshctl.fleet.journal_store import open_journal
    from meshctl.inventory import load_fleet

    fleet = load_fleet(inventory, environ=os.environ).name
    with (
        FrameStore.open_running(history_path(fleet, lab)) as opened,
        open_journal(
            os.environ, echo_error, lab="" if lab is None else str(lab), changes_nothing=changes_nothing
        ) as journal,
    ):
        if (exchange := journal.alarm_exchange(fleet)) is not None:
            opened.on_action = exchange.send
        yield opened


@app.command("list")
def list_alarms(
    include_all: Annotated[bool, typer.Option("--all", help="Include alarms that have ended.")] = False,
    inventory: InventoryPath = Path(),
    store: HistoryFile = None,
    lab: Lab = None,
    as_json: AsJson = False,
) -> None:
    """List the open alarms, the most severe first, with their age and who is handling them.

    Exit code: 0 none open that is neither acknowledged nor silenced (notes do not count), 1 some are, 2 could not run.

    Example: meshctl alarms list --all
    """
    with _history(inventory, lab, store, changes_nothing=True) as history:
        now_s = time.time()
        found = history.alarms(active_only=not include_all, now_s=now_s)
        frame = history.latest()
    if as_json:
        echo_json(json.dumps([alarm.as_json() for alarm in found], indent=2))
    else:
        for line in _lines(found, now_s, None if frame is None else frame.time_s):
            echo(line)
    is_loud = any(
        alarm.ended_s is None and alarm.level != "note" and alarm.acknowledged is None and alarm.silenced is None
        for alarm in found
    )
    raise typer.Exit(ExitCode.FINDINGS if is_loud else ExitCode.OK)


def _lines(alarms: tuple[LoggedAlarm, ...], now_s: float, newest_s: float | None) -> Iterator[str]:
    if newest_s is None:
        yield "nothing has been recorded yet"
        return
    for alarm in alarms:
        state = f"since {duration(max(0.0, now_s - alarm.first_s))}"
        if alarm.ended_s is not None:
            state = f"ended {duration(max(0.0, now_s - alarm.ended_s))} ago, after {_lasted(alarm)}"
        yield f"{alarm.level}: {alarm.device or _FLEET_WORD} {alarm.code}: {alarm.text} ({state})"
        if alarm.acknowledged is not None:
            ago = duration(max(0.0, now_s - alarm.acknowledged.at_s))
            yield f"  acknowledged by {alarm.acknowledged.by} {ago} ago"
        if alarm.silenced is not None:
            until_s = alarm.silenced.until_s
            rest = "" if until_s is None else f" for another {duration(max(0.0, until_s - now_s))}"
            yield f"  silenced by {alarm.silenced.by}{rest}: {alarm.silenced.reason}"
        elif alarm.hint and alarm.ended_s is None:
            yield f"  {alarm.hint}"
    if not alarms:
        yield "no alarms"
    yield f"last snapshot {duration(max(0.0, now_s - newest_s))} ago"


def _lasted(alarm: LoggedAlarm) -> str:
    return duration(max(0.0, (alarm.ended_s or alarm.last_s) - alarm.first_s))


@app.command("ack")
def acknowledge(
    device: Device,
    code: Code,
    by: By = None,
    inventory: InventoryPath = Path(),
    store: HistoryFile = None,
    lab: Lab = None,
) -> None:
    """Acknowledge an open alarm: you are handling it. It is reported again if it ends and comes back later.

    Example: meshctl alarms ack b03 weak
    """
    with _history(inventory, lab, store) as history:
        history.acknowledge(_device(device), _code(code), by or owner(), time.time())
    echo(f"acknowledged: {device} {code}")


@app.command("silence")
def silence_alarm(
    device: Device,
    code: Code,
    reason: Annotated[str, typer.Option("--reason", help="Why; shown with the alarm.")],
    for_time: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="Duration, such as 30m, 2h or 1d; default: forever.")
    ] = None,
    by: By = None,
    inventory: InventoryPath = Path(),
    store: HistoryFile = None,
    lab: Lab = None,
) -> None:
    """Silence an alarm, now and when it comes again: no hook, no sound. `'*'` stands for any device or code.

    Example: meshctl alarms silence b03 '*' --for 2h --reason "on the bench"
    """
    until_s = None if for_time is None else time.time() + _seconds(for_time)
    with _history(inventory, lab, store) as history:
        history.silence(_device(device), _code(code), Silence(until_s, reason, by or owner()), time.time())
    echo(f"silenced{'' if for_time is None else f' for {for_time}'}: {device} {code}")


@app.command("unsilence")
def end_silence(
    device: Device, code: Code, inventory: InventoryPath = Path(), store: HistoryFile = None, lab: Lab = None
) -> None:
    """End a silence before its time.

    Example: meshctl alarms unsilence b03 '*'
    """
    with _history(inventory, lab, store) as history:
        history.end_silence(_device(device), _code(code), owner(), time.time())
    echo(f"no longer silenced: {device} {code}")


def _device(word: str) -> str:
    return FLEET if word == _FLEET_WORD else word


def _code(word: str) -> str:
    """Raises InputError for what is no code."""
    if word != ANY and word not in CODES:
        raise InputError(f"unknown alarm code {word!r}", hint=did_you_mean(word, CODES) or "docs/status.md lists them")
    return word


def _seconds(text: str) -> float:
    """Raises InputError for what is no time."""
    found = re.fullmatch(r"(\d{1,6}(?:\.\d{1,3})?)\s*(s|m|min|h|d)", text.strip())
    if found is None or not float(found[1]):
        raise InputError(f"--for: expected a time such as 30m, 2h or 1d, found {text!r}")
    return float(found[1]) * _UNITS_S[found[2]]
