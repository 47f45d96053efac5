"""Send a script of any length, and its standard input, through one SSH `exec`.

dropbear refuses long commands (MAX_CMD_LEN: 9000 bytes from 2019.78 to 2025.88), so a long script precedes its input on
stdin: the command is a fixed reader that collects lines up to a mark and evaluates them. ash's `read` reads single
bytes from a pipe, so everything after the mark is left for the script.
"""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

# Far below dropbear's 9000; a long script has no advantage as an argument, which is visible in `ps`.
MAX_COMMAND_BYTES = 900

_READER = """\
s=; while IFS= read -r l && [ "$l" != {mark} ]; do s="$s$l
"; done; [ "$l" = {mark} ] || exit 126; eval "$s\""""


@dataclass(frozen=True, slots=True)
class Framed:
    """The command for `exec`, and the first bytes of stdin."""

    command: str
    preamble: bytes


def framed(script: str) -> Framed:
    """Split a script into command and preamble. Raises ValueError for a NUL, which no shell can hold."""
    if "\0" in script:
        raise ValueError("a shell script cannot hold a NUL")
    if len(script.encode()) <= MAX_COMMAND_BYTES:
        return Framed(script, b"")
    # derived from the script, so a line equal to the mark would need a SHA-256 preimage
    mark = "end-" + hashlib.sha256(script.encode()).hexdigest()[:32]
    text = script if script.endswith("\n") else script + "\n"
    return Framed(_READER.format(mark=mark), f"{text}{mark}\n".encode())


def quoted(*words: str) -> str:
    """Shell-quote words and join them."""
    return " ".join(shlex.quote(word) for word in words)


def command_line(words: Sequence[str]) -> str:
    """A user's words as the command line for a node's shell: one word unchanged, several words quoted."""
    return words[0] if len(words) == 1 else quoted(*words)
