"""State for packing small messages into shared datagrams (`send_quota.pack_until` decides by it)."""


class Packing:
    """The packing state of one peer. A datagram counts if it is not urgent, and has room to spare or holds several
    messages."""

    __slots__ = ("is_stream", "sent_at", "waiting")

    def __init__(self) -> None:
        self.sent_at = float("-inf")
        """When the last such datagram was sent."""
        self.is_stream = False
        """It held several messages: more of them are likely to come."""
        self.waiting = 0
        """Mask of the levels whose messages wait for others: the application limits how much they send."""

    def on_sent(self, fragments: int, *, has_room: bool, now: float) -> None:
        """Record a datagram that is not urgent."""
        if fragments > 1 or has_room:
            self.sent_at, self.is_stream = now, fragments > 1
