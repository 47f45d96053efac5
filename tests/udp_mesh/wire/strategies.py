"""Any value of the wire format, for property tests."""

from hypothesis import strategies as st

from udp_mesh.wire import limits
from udp_mesh.wire.frames import (
    Ack,
    Bye,
    Cancel,
    Delivered,
    Fragment,
    Frame,
    Heartbeat,
    MessageHead,
    Nack,
    Ping,
    Pong,
    Refused,
    RefuseReason,
    Sent,
    TopicAnnounce,
    Waiting,
)


def unsigned(bits: int) -> st.SearchStrategy[int]:
    return st.integers(0, (1 << bits) - 1)


names = st.text(st.characters(min_codepoint=0x21, max_codepoint=0x24F), min_size=1, max_size=20).filter(
    lambda name: name.isprintable() and "/" not in name and not any(c.isspace() for c in name)
)
texts = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x24F), max_size=40).filter(str.isprintable)
waiting = st.lists(st.builds(Waiting, st.integers(0, 15), unsigned(16)), max_size=4).map(tuple)


@st.composite
def heartbeats(draw: st.DrawFn) -> Heartbeat:
    low = draw(st.integers(1, 7))
    heard = draw(st.lists(st.binary(min_size=8, max_size=8), max_size=5))
    clock_ms = draw(st.one_of(st.none(), unsigned(32)))
    clocks = [] if clock_ms is None else draw(st.lists(unsigned(24), max_size=len(heard)))
    return Heartbeat(
        draw(names),
        low,
        draw(st.integers(low, 7)),
        draw(unsigned(32)),
        draw(st.integers(1, 65_535)),
        draw(unsigned(16)),
        draw(unsigned(32)),
        draw(unsigned(64)),
        draw(unsigned(32)),
        tuple(heard),
        draw(waiting),
        clock_ms,
        tuple(clocks),
    )


@st.composite
def first_fragments(draw: st.DrawFn) -> Fragment:
    payload = draw(st.binary(max_size=60))
    more = draw(st.booleans()) and len(payload) > 0
    size = len(payload) + (draw(st.integers(1, 5000)) if more else 0)
    fragments = draw(st.integers(2, size)) if more else 1
    head = MessageHead(
        size,
        fragments,
        draw(unsigned(16)),
        draw(st.integers(0, 15)),
        draw(unsigned(8)),
        draw(unsigned(32)),
        draw(st.one_of(st.none(), st.integers(1, (1 << 32) - 1))),
    )
    return Fragment(draw(unsigned(32)), 0, payload, head, draw(st.booleans()), draw(st.booleans()))


later_fragments = st.builds(
    Fragment,
    message_id=unsigned(32),
    position=st.one_of(st.integers(1, 70_000), st.integers(1, limits.MAX_FRAGMENTS_PER_MESSAGE - 1)),
    payload=st.binary(min_size=1, max_size=60),
    head=st.none(),
    ack_now=st.booleans(),
    broadcast_id=st.booleans(),
)


@st.composite
def acks(draw: st.DrawFn) -> Ack:
    largest = draw(st.one_of(st.integers(0, 300), unsigned(48)))
    covered = (1 << min(largest, limits.ACK_BITMAP_BITS)) - 1
    return Ack(largest, draw(unsigned(256)) & covered, draw(unsigned(24)), draw(unsigned(32)), draw(waiting))


id_lists = st.lists(unsigned(32), min_size=1, max_size=6).map(tuple)
ranges = st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(1, 1 << 20)), max_size=5).map(tuple)

frames: st.SearchStrategy[Frame] = st.one_of(
    heartbeats(),
    first_fragments(),
    later_fragments,
    acks(),
    st.builds(Delivered, id_lists, st.booleans()),
    st.builds(Cancel, id_lists, st.booleans()),
    st.builds(Refused, unsigned(32), st.sampled_from(RefuseReason), st.booleans()),
    st.builds(Nack, unsigned(32), ranges),
    st.builds(TopicAnnounce, unsigned(16), names, texts),
    st.builds(Ping, unsigned(64)),
    st.builds(Pong, unsigned(64), unsigned(32)),
    st.builds(Bye, texts),
    st.builds(Sent, unsigned(32)),
)
