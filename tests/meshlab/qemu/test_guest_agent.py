"""Output of a process in the machine, with a host that reads it late."""

from __future__ import annotations

import asyncio
import contextlib
import os
from typing import Any, cast

from meshlab.qemu import guest_protocol
from meshlab.qemu.guest_agent import GuestAgent
from meshlab.qemu.port_forwarder import QemuPortForwarder

# far longer than unblocked output takes
LATE_S = 0.3
EXEC: dict[str, Any] = {"kind": "exec", "request": {}, "terminal": None}


class SlowHost:
    """An `asyncio.StreamWriter` that accepts the first frame and blocks the sender before the next one."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, bytes]] = []
        self.is_waited_for = asyncio.Event()
        self.reads = asyncio.Event()

    def write(self, frame: bytes) -> None:
        stream, length = guest_protocol.header(frame[: guest_protocol.HEADER_BYTES])
        assert len(frame) == guest_protocol.HEADER_BYTES + length
        self.frames.append((stream, frame[guest_protocol.HEADER_BYTES :]))

    async def drain(self) -> None:
        self.is_waited_for.set()
        await self.reads.wait()


def test_final_output_arrives_before_the_exit_status_even_if_the_host_reads_late() -> None:
    async def run() -> list[tuple[int, bytes]]:
        host = SlowHost()

        async def process(_: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
            os.write(descriptors[1], b"first")
            await host.is_waited_for.wait()
            os.write(descriptors[1], b"last")
            asyncio.get_running_loop().call_later(LATE_S, host.reads.set)
            return {"status": 0}

        agent = GuestAgent("token", process, cast(QemuPortForwarder, None))
        await agent._execute(EXEC, asyncio.StreamReader(), cast(asyncio.StreamWriter, host))
        return host.frames

    frames = asyncio.run(asyncio.wait_for(run(), 60))
    assert frames == [
        (guest_protocol.OUTPUT, b"first"),
        (guest_protocol.OUTPUT, b"last"),
        (guest_protocol.ANSWER, b'{"status": 0}'),
    ]


def test_a_background_process_that_keeps_writing_does_not_delay_the_exit_status() -> None:
    async def run() -> int:
        host = SlowHost()
        host.reads.set()

        async def process(_: dict[str, Any], descriptors: list[int]) -> dict[str, Any]:
            behind = os.dup(descriptors[1])

            async def write_for_ever() -> None:
                os.set_blocking(behind, False)
                while True:
                    with contextlib.suppress(BlockingIOError):
                        os.write(behind, b"x" * 4096)
                    await asyncio.sleep(0)

            writing.append(asyncio.ensure_future(write_for_ever()))
            return {"status": 0}

        writing: list[asyncio.Task[None]] = []
        agent = GuestAgent("token", process, cast(QemuPortForwarder, None))
        await agent._execute(EXEC, asyncio.StreamReader(), cast(asyncio.StreamWriter, host))
        writing[0].cancel()
        return host.frames[-1][0]

    assert asyncio.run(asyncio.wait_for(run(), 60)) == guest_protocol.ANSWER
