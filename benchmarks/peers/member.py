"""A member of a team for `benchmarks.discovery_traffic`, a process in a network namespace of its own.

usage: python -m benchmarks.peers.member KIND NAME OTHERS

Prints `ready` and waits for a line on its standard input. Then it starts; once it knows OTHERS other members, it prints
the time (CLOCK_MONOTONIC) on a line.
"""

import asyncio
import sys
import time
from collections.abc import Awaitable, Callable

_POLL_S = 0.05

# starts a member of this name; its result returns the number of others that the member knows
Starter = Callable[[str], Awaitable[Callable[[], int]]]


def fast_dds(is_lean: bool) -> Starter:
    """A ROS 2 node with a publisher and a subscription of one topic; `lean`: without parameter services and rosout."""
    import rclpy
    from std_msgs.msg import UInt8MultiArray

    async def start(name: str) -> Callable[[], int]:
        rclpy.init()
        node = rclpy.create_node(name, start_parameter_services=not is_lean, enable_rosout=not is_lean)
        publisher = node.create_publisher(UInt8MultiArray, "telemetry", 10)
        subscription = node.create_subscription(UInt8MultiArray, "telemetry", lambda _: None, 10)

        def known() -> int:
            # both would end with their last reference
            assert node is not None
            assert subscription is not None
            return int(publisher.get_subscription_count()) - 1

        return known

    return start


def cyclone_dds() -> Starter:
    """A participant with a writer and a reader of one topic."""
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from benchmarks.peers.cyclone_dds import Payload

    async def start(_: str) -> Callable[[], int]:
        participant = DomainParticipant(0)
        topic = Topic(participant, "telemetry", Payload)
        writer, reader = DataWriter(participant, topic), DataReader(participant, topic)

        def known() -> int:
            # would end with its last reference
            assert reader is not None
            try:
                return len(writer.get_matched_subscriptions()) - 1
            except IndexError:
                # the binding asks for the number and then for the list, which has grown
                return 0

        return known

    return start


def udp_mesh() -> Starter:
    from udp_mesh import Node
    from udp_mesh.core.settings import Settings, Topic
    from udp_mesh.crypto import Key

    # only used by the members of a benchmark
    key, topics = Key.parse("be" * 32), (Topic("telemetry", priority=3),)

    async def start(name: str) -> Callable[[], int]:
        node = Node(Settings(name, keys=(key,), topics=topics))
        await node.__aenter__()
        return lambda: sum(peer.online for peer in node.conditions().peers)

    return start


KINDS: dict[str, Callable[[], Starter]] = {
    "fast-dds": lambda: fast_dds(is_lean=False),
    "fast-dds-lean": lambda: fast_dds(is_lean=True),
    "cyclone-dds": cyclone_dds,
    "udp-mesh": udp_mesh,
}


async def live(start: Starter, name: str, others: int) -> None:
    known = await start(name)
    while known() < others:  # noqa: ASYNC110
        await asyncio.sleep(_POLL_S)
    _say(str(time.monotonic()))
    await asyncio.Event().wait()


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main(kind: str, name: str, others: str) -> None:
    start = KINDS[kind]()
    _say("ready")
    sys.stdin.readline()
    asyncio.run(live(start, name, int(others)))


if __name__ == "__main__":
    main(*sys.argv[1:])
