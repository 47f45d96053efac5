"""The voice of `meshctl meter --speak`: phrases -> espeak-ng -> the sound card, one at a time, and what went wrong."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from typing import IO

from meshctl.errors import InputError

PROGRAM = "espeak-ng"
_MAX_MESSAGE_BYTES = 4096
# Its exit code is 0 even where there is no sound card. Its own messages begin like this; those of libasound, which also
# appear where the sound works, do not.
_FAILED = re.compile(r"^(?:error|failed)\b.*", re.IGNORECASE | re.MULTILINE)


class Voice:
    """Speaks with espeak-ng. InputError if it is not installed."""

    def __init__(self) -> None:
        if shutil.which(PROGRAM) is None:
            raise InputError(f"--speak: {PROGRAM} is not installed", hint=f"install the package {PROGRAM}")
        self._speaking: subprocess.Popen[bytes] | None = None
        self._messages: IO[bytes] | None = None
        self._problem = ""

    @property
    def is_speaking(self) -> bool:
        """Whether a phrase is being spoken."""
        self._look()
        return self._speaking is not None

    @property
    def problem(self) -> str:
        """Why the last phrase could not be heard; empty if it could."""
        self._look()
        return self._problem

    def say(self, phrase: str) -> None:
        """Speak a phrase; one that is being spoken ends first."""
        self.wait()
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the program has ended
        try:
            self._speaking = subprocess.Popen(
                [PROGRAM, "--", phrase], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._messages
            )
        except OSError as error:
            self._messages.close()
            self._problem = f"no sound: {PROGRAM}: {error.strerror}"

    def wait(self) -> None:
        """Wait until nothing is being spoken."""
        if self._speaking is not None:
            self._speaking.wait()
            self._look()

    def _look(self) -> None:
        if self._speaking is None or self._messages is None or self._speaking.poll() is None:
            return
        self._messages.seek(0)
        text = self._messages.read(_MAX_MESSAGE_BYTES).decode(errors="replace")
        self._messages.close()
        failed = _FAILED.search(text)
        if failed is not None:
            self._problem = f"no sound: {PROGRAM}: {failed[0].strip()}"
        elif self._speaking.returncode:
            self._problem = f"no sound: {PROGRAM} {_ended(self._speaking.returncode)}"
        else:
            self._problem = ""
        self._speaking = None


def _ended(code: int) -> str:
    return f"exited with {code}" if code > 0 else f"was ended by signal {-code}"
