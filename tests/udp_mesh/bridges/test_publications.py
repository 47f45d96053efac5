"""Publishing into a ROS graph whose master answers late or never: queueing and order."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tests.udp_mesh.daemon.processes import poll
from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.bridges.ros1.publications import (
    FIRST_HOLD_S,
    MAX_WAITING_BYTES,
    MAX_WAITING_MESSAGES,
    Advertised,
    Publications,
    RosPublication,
)
from udp_mesh.bridges.types import TypeKey

STRING = TypeKey("std_msgs/String", "aa")
INT = TypeKey("std_msgs/Int32", "bb")


class Graph:
    """A ROS graph in memory: a master that answers on request, and what subscribers got."""

    def __init__(self) -> None:
        self.answers = threading.Event()
        self.answers.set()
        self.subscribers = 0
        self.connected = 0
        self.now = 0.0
        self.log: list[tuple[str, str, bytes]] = []
        self.withdrawn: list[str] = []
        self.publications = Publications(self._advertise, lambda name: self.subscribers, lambda: self.now)

    def _advertise(self, message: RosPublication) -> Advertised:
        assert self.answers.wait(WAIT_S)
        return Topic(self, message)

    @contextmanager
    def running(self) -> Iterator[None]:
        stop = threading.Event()
        thread = threading.Thread(target=self.publications.run, args=(stop,))
        thread.start()
        try:
            yield
        finally:
            stop.set()
            self.answers.set()
            thread.join(WAIT_S)

    def publish(self, name: str, payload: bytes, key: TypeKey = STRING, *, latched: bool = False) -> None:
        self.publications.publish(RosPublication(name, key, "", latched, payload))

    def got(self, name: str) -> list[bytes]:
        return [payload for topic, _, payload in self.log if topic == name]


class Topic:
    def __init__(self, graph: Graph, message: RosPublication) -> None:
        self._graph, self._name, self._type = graph, message.name, message.key.name

    def connections(self) -> int:
        return self._graph.connected

    def publish(self, payload: bytes) -> None:
        self._graph.log.append((self._name, self._type, payload))

    def withdraw(self) -> None:
        self._graph.withdrawn.append(self._type)


def test_an_unresponsive_master_delays_only_new_topics() -> None:
    graph = Graph()
    with graph.running():
        graph.publish("/old", b"1")
        poll(lambda: graph.got("/old") == [b"1"], "the first")
        graph.answers.clear()
        graph.publish("/new", b"waits")
        graph.publish("/new", b"in order")
        graph.publish("/old", b"2")
        assert graph.got("/old") == [b"1", b"2"]
        assert graph.got("/new") == []
        graph.answers.set()
        poll(lambda: graph.got("/new") == [b"waits", b"in order"], "what waited")


def test_the_waiting_queue_is_bounded_and_keeps_the_newest_messages() -> None:
    graph = Graph()
    graph.answers.clear()
    for number in range(MAX_WAITING_MESSAGES + 7):
        graph.publish("/many", b"%d" % number)
    for letter in (b"a", b"b", b"c"):
        graph.publish("/large", letter * (MAX_WAITING_BYTES // 2))
    assert graph.publications.dropped == 7 + 1
    with graph.running():
        graph.answers.set()
        poll(lambda: bool(graph.got("/many") and graph.got("/large")), "what stayed")
        assert graph.got("/many")[-1] == b"%d" % (MAX_WAITING_MESSAGES + 6)
        assert [payload[:1] for payload in graph.got("/large")] == [b"b", b"c"]


def test_a_type_change_withdraws_the_previous_publisher_and_keeps_message_order() -> None:
    graph = Graph()
    with graph.running():
        for number, key in enumerate((STRING, STRING, INT, STRING)):
            graph.publish("/any", b"%d" % number, key)
        poll(lambda: len(graph.log) == 4, "all four")
    assert [kind for _, kind, _ in graph.log] == [STRING.name, STRING.name, INT.name, STRING.name]
    assert graph.got("/any") == [b"0", b"1", b"2", b"3"]
    assert graph.withdrawn == [STRING.name, INT.name]


def test_first_messages_wait_for_existing_subscribers_up_to_a_timeout() -> None:
    graph = Graph()
    graph.subscribers = 1
    with graph.running():
        graph.publish("/a", b"first")
        graph.publish("/latched", b"first", latched=True)
        poll(lambda: graph.got("/latched") == [b"first"], "what rospy itself keeps for subscribers")
        poll(lambda: ("/a", STRING.name) in graph.publications.advertised(), "/a advertised")
        assert graph.got("/a") == []
        graph.connected = 1
        poll(lambda: graph.got("/a") == [b"first"], "the first message")
        graph.connected = 0
        graph.publish("/b", b"first")
        poll(lambda: ("/b", STRING.name) in graph.publications.advertised(), "/b advertised")
        graph.now += FIRST_HOLD_S
        poll(lambda: graph.got("/b") == [b"first"], "without the subscriber that never connects")
