"""A script that a shell on the node reads once and then runs again and again, with other arguments.

`SshConnection.run_kept` starts the shell (`start`). It reads the script, then a line for each run: a mark, and the
script's arguments. It runs the script in a subshell, without input, and prints the mark and the exit status after its
output (`run`). To query a node every few seconds takes some tens of bytes then instead of the script, and the node
starts no shell and parses nothing. The shell ends with its standard input, that is with the connection.
"""

from __future__ import annotations

import math
import re
import secrets
import time
from collections.abc import Sequence

import paramiko

from meshctl.device.connection import Completed
from meshctl.device.errors import OutputTooLarge
from meshctl.device.framing import framed, quoted
from meshctl.device.ssh_channel import DISCARD_S, MAX_OUTPUT_BYTES, OPEN_ATTEMPTS, open_session

_READ_BYTES = 32 << 10
_END = re.compile(rb"(ended-[0-9a-f]{32}) (\d{1,3})\n\Z")
_END_BYTES = len("ended-") + 32 + len(" 255\n")
# Its standard error is not read, and would fill the channel.
_LOOP = """\
run() (
{script}
)
while read -r mark words; do
	eval "run $words" </dev/null 2>/dev/null
	echo "$mark $?"
done
"""


class KeptScript:
    """One such shell, in a channel of its own. Not thread-safe."""

    def __init__(self, channel: paramiko.Channel, label: str) -> None:
        self._channel = channel
        self._label = label

    @classmethod
    def start(cls, transport: paramiko.Transport, label: str, script: str) -> KeptScript:
        """Open a channel and send the script. Raises what paramiko raises.

        Some servers close a new channel (`open_session`), which may show only when the command is to start: the script
        has not run then, and a shell is started again.
        """
        sent = framed(_LOOP.format(script=script))
        for attempt in range(OPEN_ATTEMPTS):
            channel = open_session(transport)
            try:
                channel.exec_command(sent.command)
                channel.sendall(sent.preamble)
            except (paramiko.SSHException, OSError):
                if attempt == OPEN_ATTEMPTS - 1 or not transport.is_active():
                    raise
            else:
                break
        return cls(channel, label)

    @property
    def is_open(self) -> bool:
        return not (self._channel.closed or self._channel.eof_received)

    def run(self, arguments: Sequence[str]) -> Completed:
        """Run the script with these arguments; it has no standard error. Raises what paramiko raises, EOFError if the
        shell ends, OutputTooLarge, and ValueError for an argument with a line break.

        What is too much is read to its end, if that comes soon: dropbear 2022.83 may end the connection by an assertion
        (common-channel.c, `!channel->sent_close`) when a channel is closed that still has output.
        """
        mark = f"ended-{secrets.token_hex(16)}"
        line = f"{mark} {quoted(*arguments)}\n"
        if line.count("\n") > 1:
            raise ValueError("a line break in an argument")
        self._channel.sendall(line.encode())
        output = bytearray()
        discard_until = math.inf
        while (ended := _END.search(output, max(0, len(output) - _END_BYTES))) is None or ended[1] != mark.encode():
            data = self._channel.recv(_READ_BYTES)
            if not data:
                raise EOFError("the node's shell ended")
            output += data
            if len(output) > MAX_OUTPUT_BYTES:
                discard_until = min(discard_until, time.monotonic() + DISCARD_S)
                # the mark may have come in part
                del output[:-_END_BYTES]
            if time.monotonic() > discard_until:
                break
        if ended is None or discard_until < math.inf:
            raise OutputTooLarge(f"{self._label}: the command printed more than {MAX_OUTPUT_BYTES >> 20} MiB")
        return Completed(bytes(output[: ended.start()]), b"", int(ended[2]))

    def close(self) -> None:
        self._channel.close()
