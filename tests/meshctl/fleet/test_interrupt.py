"""Signals as requests: the first stops, the second leaves, also without a terminal."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from meshctl.fleet import Interrupt


@contextmanager
def handled(number: signal.Signals, before: signal.Handlers) -> Iterator[None]:
    was = signal.signal(number, before)
    try:
        yield
    finally:
        signal.signal(number, was)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_requests_a_stop_and_the_second_an_immediate_exit(number: signal.Signals) -> None:
    interrupt = Interrupt()
    said: list[str] = []
    with handled(number, signal.Handlers.SIG_DFL), interrupt.on_signals(said.append):
        signal.raise_signal(number)
        assert (interrupt.stopping, interrupt.leaving) == (True, False)
        signal.raise_signal(number)
        assert interrupt.leaving
    assert len(said) == 2


def test_repeated_hangups_request_only_a_stop() -> None:
    interrupt = Interrupt()
    with handled(signal.SIGHUP, signal.Handlers.SIG_DFL), interrupt.on_signals(lambda text: None):
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
    assert (interrupt.stopping, interrupt.leaving) == (True, False)


def test_sighup_is_ignored_under_nohup() -> None:
    interrupt = Interrupt()
    with handled(signal.SIGHUP, signal.Handlers.SIG_IGN), interrupt.on_signals(lambda text: None):
        signal.raise_signal(signal.SIGHUP)
        assert not interrupt.stopping


def test_a_request_counts_even_if_the_terminal_is_closed() -> None:
    def closed(text: str) -> None:
        raise OSError(5, "Input/output error")

    interrupt = Interrupt()
    with handled(signal.SIGHUP, signal.Handlers.SIG_DFL), interrupt.on_signals(closed):
        signal.raise_signal(signal.SIGHUP)
    assert interrupt.stopping


@pytest.mark.parametrize(("options", "signals"), [("", 3), (", is_only_reading=True", 2)])
def test_the_last_signal_ends_the_process_whatever_its_threads_wait_for(options: str, signals: int) -> None:
    script = (
        "import signal, threading; from meshctl.fleet import Interrupt\n"
        "threading.Thread(target=threading.Event().wait).start()\n"
        f"with Interrupt().on_signals(print{options}):\n"
        f"    for _ in range({signals}): signal.raise_signal(signal.SIGINT)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (130, "ended\n")
