"""Whether a message may be accepted: the limits on what waits, for one peer and for all together."""

from udp_mesh.core.events import Rejected, RejectReason
from udp_mesh.core.sender.send_memory import COPY_BYTES, with_urgent_extra
from udp_mesh.core.settings import Outbox, Topic
from udp_mesh.core.state import State


def check_capacity(state: State, topic: Topic, names: list[str], size_bytes: int) -> Rejected | None:
    """Why a message of this size is refused; None if there is room for it. No `names`: to all."""
    limits = state.settings.limits
    urgent = topic.priority <= state.settings.rates.urgent_priority
    max_bytes = with_urgent_extra(limits.queue_bytes_per_peer, urgent=urgent)
    max_messages = with_urgent_extra(limits.queue_messages_per_peer, urgent=urgent)
    for name in names or [peer.name for peer in state.peer_table.online()]:
        peer = state.peer_table.peers.get(name)
        if peer is None:
            if topic.outbox is Outbox.NONE and name not in topic.destinations:
                return Rejected(RejectReason.UNKNOWN_PEER, f"{name} is not a known peer")
            if len(state.peer_table.peers) >= limits.peers:
                return Rejected(RejectReason.QUEUE_FULL, f"limit of {limits.peers} peers reached")
            continue
        sender = peer.sender
        if sender is None:
            continue
        if sender.levels.queued_bytes + size_bytes > max_bytes or len(sender.pending) >= max_messages:
            return Rejected(RejectReason.QUEUE_FULL, f"queue for {name} is full")
    if topic.compression and state.compression_queue.bytes + size_bytes > max_bytes:
        return Rejected(RejectReason.QUEUE_FULL, "compression queue is full")
    if not names and state.broadcasts.queued() >= max_messages:
        return Rejected(RejectReason.QUEUE_FULL, "broadcast queue is full")
    return _check_memory(state, topic, names, size_bytes, urgent=urgent)


def _check_memory(state: State, topic: Topic, names: list[str], size_bytes: int, *, urgent: bool) -> Rejected | None:
    """The same for the memory that all waiting messages share (see `SendMemory`)."""
    memory = state.peer_table.send_memory
    # Compressed messages keep both forms.
    size_bytes *= 2 if topic.compression else 1
    size_bytes += COPY_BYTES * (len(names) or len(state.peer_table.peers))
    waiting = memory.bytes + 2 * state.compression_queue.bytes + state.selection.withheld_bytes
    if waiting + size_bytes > with_urgent_extra(memory.limit, urgent=urgent):
        return Rejected(
            RejectReason.QUEUE_FULL,
            f"{waiting >> 20} MiB wait for all peers together, and limits.queue_bytes is {memory.limit >> 20} MiB",
        )
    if urgent or waiting + size_bytes <= memory.limit // 2:
        return None
    share = memory.share()
    for name in names or [peer.name for peer in state.peer_table.online()]:
        if memory.waiting_bytes(name) + size_bytes > share:
            return Rejected(
                RejectReason.QUEUE_FULL,
                f"queue for {name} is full: while more than half of limits.queue_bytes is used, "
                f"each peer may use {share >> 20} MiB",
            )
    return None
