"""A monitor follows what other operators do about alarms: journal -> this monitor's history -> its page.

`SharedAlarms.run` is a thread: it applies the actions that are there, then each one as it comes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from meshctl.errors import MeshctlError
from meshctl.fleet.alarm_actions import AlarmActionKind, AlarmExchange
from meshctl.monitor.store import FrameStore

# How long a thread waits before it asks a database again that is out of reach, and how long it waits for changes.
RETRY_S = 10.0
_WAIT_S = 2.0


class SharedAlarms:
    """`on_change` is called after actions were applied; `on_problem` with why they cannot be followed now."""

    def __init__(
        self,
        exchange: AlarmExchange,
        history: FrameStore,
        *,
        on_change: Callable[[], None] = lambda: None,
        on_problem: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._exchange, self._history = exchange, history
        self._on_change, self._on_problem = on_change, on_problem
        newest = history.latest()
        self._since_s = 0.0 if newest is None else newest.time_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self.run, name="shared alarms", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._end.set()
        self._thread.join(_WAIT_S + 1.0)

    def run(self) -> None:
        problem = ""
        while not self._end.is_set():
            try:
                self.take()
                self._exchange.wait(_WAIT_S)
                problem = ""
            except MeshctlError as error:
                if str(error) != problem and not self._end.is_set():
                    problem = str(error)
                    self._on_problem(f"alarms of other operators are not followed: {problem}")
                self._end.wait(RETRY_S)

    def take(self) -> None:
        """Apply what came. Raises MeshctlError."""
        actions = self._exchange.receive(time.time())
        for action in actions:
            # one from before may be of a warning that has become an error since
            if action.kind is not AlarmActionKind.ACKNOWLEDGE or action.at_s >= self._since_s:
                self._history.apply(action)
        if actions:
            self._on_change()
