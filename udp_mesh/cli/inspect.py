"""`status`, `peers`, `topics`, `logs`, `subscriptions`, `events`, `metrics`: show the daemon's state."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Callable
from typing import NoReturn

from udp_mesh.cli.output import (
    Exit,
    counted,
    fields_text,
    print_json,
    print_json_line,
    print_text,
    write_raw,
    write_text,
)
from udp_mesh.cli.views import Json, logs_view, peers_view, status_view, subscriptions_view, topics_view
from udp_mesh.client.mesh_client import MeshClient, MeshError
from udp_mesh.report.terminal_escapes import clean

HOME, END_OF_LINE, BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
"""Move to the upper left corner; clear to the end of the line; clear everything below (ECMA-48)."""


def status(arguments: argparse.Namespace) -> int:
    return _show(arguments, "status", status_view)


def peers(arguments: argparse.Namespace) -> int:
    return _show(arguments, "peers", lambda reply: peers_view(reply["peers"]))


def topics(arguments: argparse.Namespace) -> int:
    return _show(arguments, "topics", topics_view)


def logs(arguments: argparse.Namespace) -> int:
    return _show(arguments, "logs", logs_view)


def subscriptions(arguments: argparse.Namespace) -> int:
    return _show(arguments, "subscriptions", subscriptions_view)


def _show(arguments: argparse.Namespace, op: str, view: Callable[[Json], str]) -> int:
    """Shows a reply once, or repeatedly with `--watch`, as one screen or one JSON line each time."""
    if arguments.watch is not None:
        _watch(arguments, op, view)
    with MeshClient(arguments.socket) as mesh:
        reply = _request(mesh, op)
    if arguments.json:
        print_json(reply)
    else:
        print_text(view(reply))
    return Exit.OK


def _watch(arguments: argparse.Namespace, op: str, view: Callable[[Json], str]) -> NoReturn:
    """Runs until Ctrl-C. Once connected, waits for a daemon that goes away: it may be restarting."""
    period_s: float = arguments.watch
    was_connected = is_away = False
    while True:
        try:
            with MeshClient(arguments.socket) as mesh:
                while True:
                    reply = _request(mesh, op)
                    was_connected, is_away = True, False
                    if arguments.json:
                        print_json_line(reply)
                    else:
                        _redraw(view(reply))
                    time.sleep(period_s)
        except MeshError as error:
            if error.code != "unreachable" or not was_connected:
                raise
            if not is_away and not arguments.json:
                _redraw(f"{error}; waiting for the daemon")
            is_away = True
        time.sleep(period_s)


def _request(mesh: MeshClient, op: str) -> Json:
    reply = mesh.request(op)
    del reply["id"], reply["ok"]
    return reply


def _redraw(text: str) -> None:
    """Prints the text, on a terminal in place of the previous one."""
    if sys.stdout.isatty():
        columns, lines = shutil.get_terminal_size()
        write_raw(screen_text(text, columns, lines))
    else:
        print_text(text)


def screen_text(text: str, columns: int, lines: int) -> str:
    """The text that replaces the previous one on a terminal without flicker; excess lines are cut off, and the last
    line says so."""
    rows = clean(text).split("\n")
    max_rows = max(lines - 1, 1)
    if len(rows) > max_rows:
        hidden = counted(len(rows) - max_rows + 1, "more line")
        rows = [*rows[: max_rows - 1], f"... {hidden} (run without --watch to see all)"]
    return HOME + "".join(f"{row[:columns]}{END_OF_LINE}\n" for row in rows) + BELOW


def events(arguments: argparse.Namespace) -> int:
    """Prints events as they happen: peers that come and go, conflicts, starvation."""
    with MeshClient(arguments.socket) as mesh:
        mesh.request("events")
        while True:
            frame = mesh.next_frame()
            if frame is not None:
                fields = frame[0]
                print_json_line(fields) if arguments.json else print_text(
                    f"{fields.pop('event')} {fields_text(fields)}"
                )


def metrics(arguments: argparse.Namespace) -> int:
    """Prints the metrics in Prometheus text format."""
    with MeshClient(arguments.socket) as mesh:
        _, page = mesh.request_frame("metrics")
        write_text(page.decode())
    return Exit.OK
