"""How a script of any length, and its standard input, travel through one SSH `exec`.

dropbear refuses long commands (MAX_CMD_LEN: 9000 bytes from 2019.78 to 2025.88) and has no other way in, so a long
script goes ahead of its input on stdin: the command is a fixed reader that collects lines up to a mark, and then
evaluates them. ash's `read` takes single bytes from a pipe, so whatever follows the mark is left for the script.
"""

from __future__ import annotations

import hashlib
import shlex
from dataclasses import dataclass

# Far below dropbear's 9000: what is longer gains nothing by travelling as an argument, which others see in `ps`.
MAX_COMMAND_BYTES = 900

_READER = """\
s=; while IFS= read -r l && [ "$l" != {mark} ]; do s="$s$l
"; done; [ "$l" = {mark} ] || exit 126; eval "$s\""""


@dataclass(frozen=True, slots=True)
class Framed:
    """The command for `exec` and what stdin starts with."""

    command: str
    preamble: bytes


def framed(script: str) -> Framed:
    """Raises ValueError for a NUL, which no shell can hold."""
    if "\0" in script:
        raise ValueError("a shell script cannot hold a NUL")
    if len(script.encode()) <= MAX_COMMAND_BYTES:
        return Framed(script, b"")
    # derived from the script, so no line of it can be the mark except by a preimage of SHA-256
    mark = "end-" + hashlib.sha256(script.encode()).hexdigest()[:32]
    text = script if script.endswith("\n") else script + "\n"
    return Framed(_READER.format(mark=mark), f"{text}{mark}\n".encode())


def quoted(*words: str) -> str:
    """Words as one line of shell, each taken literally."""
    return " ".join(shlex.quote(word) for word in words)
