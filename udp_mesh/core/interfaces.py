"""The interfaces between a node and its driver, apart from events and settings: datagrams, random numbers, work beside
the node, the store."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from typing import NamedTuple, Protocol

from udp_mesh.core.settings import Address


class Datagram(NamedTuple):
    """One UDP datagram to send on a link. `destination` None means the link's broadcast address.

    Consecutive bulk datagrams to one destination have the same size (the last may be shorter), ready for segmentation
    offload. An `urgent` one is worth its own system call if the driver batches. A tuple, because it is created tens of
    thousands of times a second.
    """

    link: str
    destination: Address | None
    data: bytes
    urgent: bool

    @classmethod
    def run(cls, link: str, destination: Address, run: Iterable[bytes]) -> Iterator["Datagram"]:
        """Bulk datagrams to one destination, created without a Python call for each."""
        return map(partial(tuple.__new__, cls), zip(repeat(link), repeat(destination), run, repeat(False)))


class RandomSource(Protocol):
    """The part of `random.Random` that a node uses."""

    def random(self) -> float:
        """A float in [0, 1)."""
        ...

    def getrandbits(self, k: int, /) -> int:
        """An integer of k random bits."""
        ...


class Background(Protocol):
    """Where work of many milliseconds is done beside the node: the daemon has a thread for it."""

    def __call__(self, work: Callable[[], None]) -> Callable[[], bool]:
        """Start `work`, which touches nothing of the node. The answer says whether it is done, also if it failed; then
        the driver calls `handle_timer` soon."""
        ...


def in_foreground(work: Callable[[], None]) -> Callable[[], bool]:
    """A `Background` of tests and simulations, where computing takes no time: the work is done at once."""
    work()
    return lambda: True


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """One message held for one peer by a topic whose outbox is on disk.

    `key` is unique within the store and orders messages by age. Deadlines are not stored as wall-clock times:
    `remaining_s` is what was left of the lifetime when the message was stored, and it restarts with the node.
    """

    key: int
    peer: str
    topic: str
    type_name: str
    payload: bytes
    remaining_s: float | None


class Store(Protocol):
    """Where outboxes on disk are kept; the daemon's store is a directory. Calls are few and do not wait for the
    disk."""

    def put(self, message: StoredMessage) -> bool:
        """Keep the message until `remove`. False: no room. The store defines from when on the message survives a
        crash."""
        ...

    def holds(self, key: int) -> bool:
        """Whether the message is kept, or about to be. False once the disk has refused it."""
        ...

    def remove(self, key: int) -> None:
        """Remove the message; unknown keys are ignored."""
        ...

    def load(self) -> list[StoredMessage]:
        """Everything kept, oldest first. Called once, when a node starts."""
        ...
