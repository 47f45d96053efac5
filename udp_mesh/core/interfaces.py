"""What the driver hands to a node besides bytes and the time, and what the node hands back to be sent."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from typing import NamedTuple, Protocol

from udp_mesh.core.settings import Address


class Datagram(NamedTuple):
    """One UDP datagram to send on a link. `destination` None means the link's broadcast address.

    Consecutive bulk datagrams to one destination have one size (the last may be shorter), ready for segmentation
    offload. An `urgent` one is worth its own system call if the driver batches. A tuple, because it is made tens of
    thousands of times a second.
    """

    link: str
    destination: Address | None
    data: bytes
    urgent: bool

    @classmethod
    def run(cls, link: str, destination: Address, run: Iterable[bytes]) -> Iterator["Datagram"]:
        """Bulk datagrams to one destination, made without a call in Python for each."""
        return map(partial(tuple.__new__, cls), zip(repeat(link), repeat(destination), run, repeat(False)))


class RandomSource(Protocol):
    """The part of `random.Random` that a node draws from."""

    def random(self) -> float:
        """A float in [0, 1)."""
        ...

    def getrandbits(self, k: int, /) -> int:
        """An integer of k random bits."""
        ...


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """One message held for one peer by a topic whose outbox is on disk.

    `key` is unique within the store and orders messages by age. `wall_deadline` is not kept: a deadline's life restarts
    when the node does, so `remaining_s` is what was left when it was stored.
    """

    key: int
    peer: str
    topic: str
    type_name: str
    payload: bytes
    remaining_s: float | None


class Store(Protocol):
    """Where outboxes on disk live; the daemon's is a directory. Calls are few and wait for no disk."""

    def put(self, message: StoredMessage) -> bool:
        """Keep the message until `remove`; False: there is no room. When it survives a crash is the store's to tell."""
        ...

    def holds(self, key: int) -> bool:
        """Whether the message is kept, or about to be; False once the disk has refused it."""
        ...

    def remove(self, key: int) -> None:
        """Forget the message; unknown keys are ignored."""
        ...

    def load(self) -> list[StoredMessage]:
        """Everything kept, oldest first; called once, when a node starts."""
        ...
