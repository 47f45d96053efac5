"""ROS 2 with Fast DDS by rclpy: bulk and urgent are two topics of std_msgs/UInt8MultiArray, both reliable.

The settings are those of the XML file in FASTDDS_DEFAULT_PROFILES_FILE: `fast_dds_udp.xml` or `fast_dds_tcp.xml`. A
program asks for the system's default quality of service, so that the file's values apply.

rclpy publishes with the interpreter locked. Over UDP (variant `one node`), both topics share one node, so that one
flow controller orders them; a full history refuses a sample at once. Over TCP (variant `two nodes`), publishing waits
for the connection: bulk has a node in a process of its own, and with it a connection of its own.

usage of that process: python -m benchmarks.peers.fast_dds <messages, each after its length; "ready" once connected
"""

from __future__ import annotations

import array
import asyncio
import ctypes
import signal
import struct
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import UInt8MultiArray

_MATCH_TIMEOUT_S = 30.0
# from here on the other end has matched, too
_SETTLE_S = 1.0
_RETRY_S = 0.01
_LENGTH = struct.Struct("<I")
_PR_SET_PDEATHSIG = 1


def _quality() -> Any:
    return QoSProfile(
        history=QoSHistoryPolicy.SYSTEM_DEFAULT, depth=1000, reliability=QoSReliabilityPolicy.SYSTEM_DEFAULT
    )


def _message(data: bytes) -> Any:
    return UInt8MultiArray(data=array.array("B", data))


@contextmanager
def _publishers(*topics: str) -> Iterator[list[Any]]:
    """Publishers of one node, matched with their subscriptions, which multicast finds."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node(f"{topics[0]}_sender")
        publishers = [node.create_publisher(UInt8MultiArray, topic, _quality()) for topic in topics]
        until_s = time.monotonic() + _MATCH_TIMEOUT_S
        while not all(publisher.get_subscription_count() for publisher in publishers):
            if time.monotonic() > until_s:
                raise TimeoutError(f"no subscription to {', '.join(topics)} was found")
            time.sleep(0.05)
        time.sleep(_SETTLE_S)
        yield publishers
    finally:
        rclpy.shutdown()


@dataclass(frozen=True, slots=True)
class _OneNode:
    bulk_publisher: Any
    urgent_publisher: Any

    async def bulk(self, data: bytes) -> None:
        message = _message(data)
        while True:
            try:
                self.bulk_publisher.publish(message)
                return
            except RCLError:
                # its history is full
                await asyncio.sleep(_RETRY_S)

    async def urgent(self, data: bytes) -> None:
        self.urgent_publisher.publish(_message(data))


@dataclass(frozen=True, slots=True)
class _TwoNodes:
    bulk_writer: asyncio.StreamWriter
    urgent_publisher: Any

    async def bulk(self, data: bytes) -> None:
        self.bulk_writer.write(_LENGTH.pack(len(data)) + data)
        await self.bulk_writer.drain()

    async def urgent(self, data: bytes) -> None:
        self.urgent_publisher.publish(_message(data))


@dataclass(frozen=True, slots=True)
class _Transport:
    has_two_nodes: bool

    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_OneNode | _TwoNodes]:
        if not self.has_two_nodes:
            with _publishers("bulk", "urgent") as publishers:
                yield _OneNode(*publishers)
            return
        pipe = asyncio.subprocess.PIPE
        child = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "benchmarks.peers.fast_dds", stdin=pipe, stdout=pipe
        )
        assert child.stdin is not None
        assert child.stdout is not None
        # one message waits, as in the other transports' buffers
        child.stdin.transport.set_write_buffer_limits(high=0)
        try:
            with _publishers("urgent") as publishers:
                if await child.stdout.readline() != b"ready\n":
                    raise RuntimeError("the node that sends bulk did not start")
                yield _TwoNodes(child.stdin, *publishers)
        finally:
            child.kill()
            await child.wait()

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("receiver")

        def take(message: Any) -> None:
            on_message(message.data.tobytes())

        for topic in ("bulk", "urgent"):
            node.create_subscription(UInt8MultiArray, topic, take, _quality())
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        spinning = threading.Thread(target=partial(_spin, executor))
        spinning.start()
        try:
            yield
        finally:
            rclpy.shutdown()
            await asyncio.to_thread(spinning.join)


def _spin(executor: Any) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        # the receiver is closing
        return


def transport(variant: str) -> _Transport:
    return _Transport(has_two_nodes={"one node": False, "two nodes": True}[variant])


def main() -> None:
    # ends with the sender, even while it waits for the connection
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    with _publishers("bulk") as (publisher,):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        while length := sys.stdin.buffer.read(_LENGTH.size):
            publisher.publish(_message(sys.stdin.buffer.read(*_LENGTH.unpack(length))))


if __name__ == "__main__":
    main()
