"""The messages of a sender's boot that were delivered here, over any link: further copies are dropped."""

from __future__ import annotations

from collections import OrderedDict

from udp_mesh.wire.limits import HEARD_TAG_BYTES

MAX_BOOTS = 256
"""Boots of holders of the key; the one heard least recently is forgotten."""
MAX_REMEMBERED = 1024
"""Messages of one boot: far more than are on their way at once."""


class MessageCopies:
    """Numbers of delivered messages, by the boot tag of their sender."""

    def __init__(self) -> None:
        self._boots: OrderedDict[bytes, OrderedDict[int, None]] = OrderedDict()
        self.dropped = 0

    def is_first(self, boot_id: bytes, number: int) -> bool:
        """Whether this copy is the first one; it is remembered. `boot_id` may be the tag alone."""
        numbers = self._numbers(boot_id)
        if number in numbers:
            self.dropped += 1
            return False
        numbers[number] = None
        if len(numbers) > MAX_REMEMBERED:
            numbers.popitem(last=False)
        return True

    def knows(self, boot_id: bytes, number: int) -> bool:
        """Whether the message was delivered."""
        numbers = self._boots.get(boot_id[:HEARD_TAG_BYTES])
        return numbers is not None and number in numbers

    def _numbers(self, boot_id: bytes) -> OrderedDict[int, None]:
        tag = bytes(boot_id[:HEARD_TAG_BYTES])
        numbers = self._boots.setdefault(tag, OrderedDict())
        self._boots.move_to_end(tag)
        if len(self._boots) > MAX_BOOTS:
            self._boots.popitem(last=False)
        return numbers
