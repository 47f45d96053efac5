"""Ctrl-C while the program is imported, which takes seconds on a busy machine.

Nothing has been done yet, so the process ends at once. An exception would be a traceback, and is lost where Python
ignores exceptions, as in callbacks of its import system.
"""

import os
import signal

# `meshctl.errors.ExitCode.INTERRUPTED`, which is not imported yet
_INTERRUPTED = 130


def end_at_ctrl_c() -> None:
    """Until `raise_at_ctrl_c`. A process that ignores SIGINT, as in the background of a script, still does."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def raise_at_ctrl_c() -> None:
    """From now on KeyboardInterrupt, if `end_at_ctrl_c` was called."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(*_signal: object) -> None:
    os.write(2, b"interrupted\n")
    os._exit(_INTERRUPTED)
