"""Signals as requests: the first stops, the second leaves, and nobody has to be there to read about it."""

from __future__ import annotations

import signal
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_asks_to_stop_and_a_second_one_to_leave(number: signal.Signals) -> None:
    interrupt = Interrupt()
    said: list[str] = []
    with handled(number, signal.Handlers.SIG_DFL), interrupt.on_signals(said.append):
        signal.raise_signal(number)
        assert (interrupt.stopping, interrupt.leaving) == (True, False)
        signal.raise_signal(number)
        assert interrupt.leaving
    assert len(said) == 2


def test_under_nohup_a_closed_terminal_asks_for_nothing() -> None:
    interrupt = Interrupt()
    with handled(signal.SIGHUP, signal.Handlers.SIG_IGN), interrupt.on_signals(lambda text: None):
        signal.raise_signal(signal.SIGHUP)
        assert not interrupt.stopping


def test_a_request_counts_where_nobody_can_be_told_any_more() -> None:
    def closed(text: str) -> None:
        raise OSError(5, "Input/output error")

    interrupt = Interrupt()
    with handled(signal.SIGHUP, signal.Handlers.SIG_DFL), interrupt.on_signals(closed):
        signal.raise_signal(signal.SIGHUP)
    assert interrupt.stopping
