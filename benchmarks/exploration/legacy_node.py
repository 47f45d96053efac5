"""The legacy transport as a ROS 1 node, for the comparison: written from its wire format, its ROS names and its loop
(docs/facts/legacy-wire.md), with the window, the timeouts and the losses of `LegacyProgram`.

    python3 -m benchmarks.exploration.legacy_node NAME ADDRESS BROADCAST '{"TOPIC": PRIORITY}' OTHER...

As there, one thread has the socket. Each turn of its loop takes one message from ROS, waits up to 10 ms for one
datagram, and sends at most five fragments of broadcasts. A message to an offline peer is dropped.
"""

from __future__ import annotations

import json
import queue
import select
import socket
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import rospy
from std_msgs.msg import String

from tests.udp_mesh.core.legacy_program import OFFLINE_TIMEOUT_S, LegacyProgram
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.legacy import (
    Host,
    LegacyAck,
    LegacyDatagram,
    LegacyPayload,
    PriorityMeshData,
    decode_legacy,
    encode_legacy,
    encode_mesh_data,
    fragment_legacy,
)

PORT = 8700
HEARTBEAT_S = 1.0
SELECT_S = 0.01
BROADCAST_FRAGMENTS = 5
"""A longer message to all is sent to each peer; and so many leave in one turn of the loop."""
FRAGMENT_BYTES = 1300
FIRST_BROADCAST = 0x8000
TO_ALL = "all"
TYPE = "std_msgs/String"


@dataclass
class Peer:
    name: str
    address: str
    heard_at: float
    is_offline: bool = False
    program: LegacyProgram = field(default_factory=LegacyProgram)


class LegacyNode:
    """The transport of one robot."""

    def __init__(self, name: str, address: str, broadcast: str, priorities: dict[str, int], others: list[str]) -> None:
        self.name, self.address, self.broadcast = name, address, broadcast
        self.peers: dict[str, Peer] = {}
        """By address, once heard."""
        self.broadcasts: list[LegacyPayload] = []
        self.broadcast_sequence = FIRST_BROADCAST
        self.from_ros: queue.Queue[PriorityMeshData] = queue.Queue()
        self.publishers: dict[tuple[str, str], Any] = {}
        self.socket = socket.socket(type=socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self.socket.bind(("", PORT))
        for topic, priority in priorities.items():
            for other in (TO_ALL, *others):
                part = "" if other == TO_ALL else f"{other}/"
                rospy.Subscriber(
                    f"/{name}/mesh_comm/{part}{topic}", rospy.AnyMsg, self.on_ros, (other, priority, topic)
                )

    def on_ros(self, message: Any, about: tuple[str, int, str]) -> None:
        host, priority, topic = about
        # `_buff` is the message as it was serialized
        self.from_ros.put(PriorityMeshData(host, TYPE, priority, topic, message._buff))

    def run(self) -> None:
        heartbeat_at = 0.0
        while not rospy.is_shutdown():
            now = time.monotonic()
            if now >= heartbeat_at:
                heartbeat_at = now + HEARTBEAT_S
                self.send(Host(self.name, self.address), self.broadcast)
            with suppress(queue.Empty):
                self.send_message(self.from_ros.get_nowait(), now)
            if select.select([self.socket], [], [], SELECT_S)[0]:
                raw, (address, _) = self.socket.recvfrom(65536)
                if address != self.address:
                    self.receive(raw, address)
            self.check_peers(time.monotonic())
            for fragment in self.broadcasts[:BROADCAST_FRAGMENTS]:
                self.send(fragment, self.broadcast)
            del self.broadcasts[:BROADCAST_FRAGMENTS]

    def send(self, datagram: LegacyDatagram, address: str) -> None:
        self.socket.sendto(encode_legacy(datagram), (address, PORT))

    def send_message(self, message: PriorityMeshData, now: float) -> None:
        data = encode_mesh_data(message)
        if message.host == TO_ALL and len(data) < FRAGMENT_BYTES * BROADCAST_FRAGMENTS:
            self.broadcast_sequence = (self.broadcast_sequence + 1) & 0xFFFF | FIRST_BROADCAST
            chunks = fragment_legacy(data)
            self.broadcasts += [
                LegacyPayload(self.broadcast_sequence, place, len(chunks), chunk, wants_ack=False)
                for place, chunk in enumerate(chunks)
            ]
            return
        for peer in self.peers.values():
            if not peer.is_offline and message.host in (TO_ALL, peer.name):
                peer.program.push_message(message)
                self.fill(peer, now)

    def fill(self, peer: Peer, now: float) -> None:
        for fragment in peer.program.fill_in_flight(now):
            self.send(fragment, peer.address)

    def receive(self, raw: bytes, address: str) -> None:
        now = time.monotonic()
        try:
            datagram = decode_legacy(raw)
        except DecodeError:
            return
        if isinstance(datagram, Host):
            peer = self.peers.setdefault(address, Peer(datagram.name, address, now))
            peer.heard_at, peer.is_offline = now, False
            return
        known = self.peers.get(address)
        if known is None:
            return
        known.is_offline = False
        if isinstance(datagram, LegacyAck):
            known.program.on_ack(datagram)
            self.fill(known, now)
            return
        ack, message = known.program.on_fragment(datagram, now)
        if datagram.wants_ack:
            self.send(ack, address)
        if message is not None:
            self.publish(known.name, message)

    def check_peers(self, now: float) -> None:
        for peer in self.peers.values():
            if peer.is_offline:
                continue
            if now - peer.heard_at > OFFLINE_TIMEOUT_S or peer.program.is_stalled(now):
                peer.is_offline = True
                peer.program.flush()
            peer.program.prune(now)

    def publish(self, source: str, message: PriorityMeshData) -> None:
        made = String()
        made.deserialize(message.data)
        place = (source, message.topic)
        if place not in self.publishers:
            name = f"/{source}/mesh_comm/{self.name}/{message.topic}"
            self.publishers[place] = rospy.Publisher(name, String, queue_size=10)
        self.publishers[place].publish(made)


def main() -> None:
    name, address, broadcast, priorities, *others = sys.argv[1:]
    rospy.init_node("rudp_mesh", disable_signals=True)
    node = LegacyNode(name, address, broadcast, json.loads(priorities), others)
    sys.stdout.write('{"ready": true}\n')
    sys.stdout.flush()
    node.run()


if __name__ == "__main__":
    main()
