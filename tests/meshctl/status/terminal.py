"""A program on a terminal of its own, as a person has it in front of them: its size, its keys, what it shows."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import select
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Mapping, Sequence
from types import TracebackType

from tests.waiting import until

PATIENCE_S = 120.0
# Becomes the program in the terminal's session. Between fork and exec of a process with threads no Python may run,
# so what must be done there is done after an exec. A run of tests in the background may have Ctrl-C switched off. A
# `shell` is what lets a stopped program go on. The program itself takes the terminal before it shows anything: its
# parent may be late, and may not move it to another process group after the exec (setpgid(2), EACCES).
_ENTER = """\
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
os.login_tty(int(sys.argv[1]))
if sys.argv[2] == "shell":
    program = os.fork()
    if program:
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(program, 0)[1]))
    os.setpgid(0, 0)
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    os.tcsetpgrp(0, os.getpid())
    signal.signal(signal.SIGTTOU, signal.SIG_DFL)
os.execv(sys.argv[3], sys.argv[3:])
"""
# Tail of the output that a failed expectation reports.
_TAIL_BYTES = 4000


class Terminal:
    """`argv` in a window of this size. `shows` waits for a pattern in what was written since the last `forget`."""

    def __init__(
        self,
        argv: Sequence[str],
        environ: Mapping[str, str],
        *,
        lines: int = 24,
        columns: int = 80,
        has_shell: bool = False,
    ) -> None:
        self._screen, inside = os.openpty()
        self._shown = b""
        try:
            self.resize(lines, columns)
            how = "shell" if has_shell else "alone"
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _ENTER, str(inside), how, *argv],
                env=dict(environ),
                pass_fds=(inside,),
            )
        except BaseException:
            os.close(self._screen)
            raise
        finally:
            os.close(inside)

    def resize(self, lines: int, columns: int) -> None:
        fcntl.ioctl(self._screen, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def press(self, keys: bytes) -> None:
        os.write(self._screen, keys)

    def signal(self, number: signal.Signals) -> None:
        os.kill(self._program, number)

    def forget(self) -> None:
        """What was shown until now counts no more."""
        self._read(0.0)
        self._shown = b""

    def shows(self, pattern: str, what: str) -> str:
        """All that was shown since the last `forget`, as soon as the pattern is in it."""

        def shown() -> str | None:
            self._read(0.05)
            text = self._shown.decode(errors="replace")
            return text if re.search(pattern, text, re.DOTALL) else None

        try:
            return until(shown, what, wait_s=PATIENCE_S)
        except AssertionError as error:
            raise AssertionError(f"{error}; state {self._state()}; shown: {self._shown[-_TAIL_BYTES:]!r}") from None

    def has_state(self, letter: str) -> None:
        """Waits until the process is in this state of proc(5): T when stopped."""
        until(lambda: self._state() == letter, f"the process in state {letter}", wait_s=PATIENCE_S)

    def exit_code(self) -> int:
        """As a shell has it, when the program has ended; what it still wrote is shown, too."""

        def ended() -> bool:
            self._read(0.0)
            return self._process.poll() is not None

        until(ended, "the end", wait_s=PATIENCE_S)
        self._read(0.0)
        return self._process.returncode

    @property
    def _program(self) -> int:
        """Whom the keys go to: of its process group this is the first."""
        return os.tcgetpgrp(self._screen)

    def _state(self) -> str:
        try:
            with open(f"/proc/{self._program}/stat") as file:
                return file.read().rpartition(") ")[2][:1]
        except OSError:
            return "gone"

    def _read(self, wait_s: float) -> None:
        """What there is; a terminal whose last program has ended gives EIO (Linux)."""
        while select.select([self._screen], [], [], wait_s)[0]:
            try:
                self._shown += os.read(self._screen, 65536)
            except OSError as error:
                if error.errno != errno.EIO:
                    raise
                return
            wait_s = 0.0

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        os.close(self._screen)
