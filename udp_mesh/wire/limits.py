"""Every cap of the wire format, with the attack or overload it bounds.

A decoder raises `DecodeError` for anything beyond its cap before it allocates. Sizes are bytes unless the name says
otherwise.
"""

MAX_DATAGRAM_BYTES = 65_507
"""Largest UDP payload over IPv4: nothing larger can arrive or is built."""

MAX_FRAMES_PER_DATAGRAM = 64
"""Bounds the work one datagram can cause (a flood of two-byte frames); real datagrams carry one to ten."""

MAX_NAME_BYTES = 63
"""A node's name: fits the 64-byte Pascal string of the legacy format, and bounds the memory a heartbeat can pin per
peer."""

MAX_TOPIC_BYTES = 255
"""A topic's name: ROS names are shorter; bounds the memory of the table of announced topics."""

MAX_LOG_TOPIC_BYTES = MAX_TOPIC_BYTES - 10
"""A log's name: its items travel on a reserved topic, whose prefix needs ten bytes."""

MAX_TYPE_BYTES = 255
"""A topic's type name (`pkg/Type`, optionally with a checksum): same reason as MAX_TOPIC_BYTES."""

MAX_REASON_BYTES = 255
"""Free text in Bye and Refused: shown to a person, never interpreted."""

MAX_MESSAGE_BYTES = 1 << 30
"""1 GiB: the largest message the format can announce. Nodes configure less; bounds what a single head can make a peer
reserve."""

MAX_FRAGMENTS_PER_MESSAGE = 1 << 21
"""2 Mi fragments (1 GiB at 512 B each). The legacy code allocated directly from a 32-bit field: this is the cap it
lacked."""

MAX_HEARD = 96
"""Neighbors that a heartbeat lists as heard (8 B each, 768 B): keeps it in one datagram whatever the team's size."""

MAX_HEARD_CLOCKS = 64
"""Clocks that a heartbeat echoes (3 B each, 192 B): a full one still fits IPv6's smallest MTU (1,280 B)."""

MAX_WAITING = 16
"""One entry for each of the 16 priority levels."""

MAX_IDS = 256
"""Message ids in one Delivered or Cancel (4 B each): bounds the lookups one datagram can cause."""

MAX_RANGES = 64
"""Ranges of missing fragments in one Nack: bounds the repairs one datagram can ask for."""

ACK_BITMAP_BITS = 256
"""Packets that an acknowledgment covers below its largest number (32 B at most, 0 B if none is missing)."""

PRIORITY_LEVELS = 16
"""Priorities 0 (most urgent) to 15: four bits on the wire."""

BOOT_ID_BYTES = 16
"""A node's random name for one run of its process: 128 bits never repeat in a fleet's life."""

HEARD_TAG_BYTES = 8
"""Leading bytes of a boot id that identify heard nodes in a heartbeat: 64 bits do not collide within a team."""

MAX_RELAY_HOPS = 8
"""Links between the ends of a relayed path: bounds how often one datagram is sent, and fits four bits."""

MAX_HEARD_HOPS = 64
"""Boots that a relay hello lists as heard (14 B each): keeps a part of it in one datagram."""

MAX_RELAYED_NODES = 32
"""Nodes in a part of a relay hello: bounds the routes one datagram can change."""

MAX_PROOFS = 2
"""Proofs of fleet keys of one node: it has one or two live keys."""

MAX_LEGACY_FRAGMENT_BYTES = 1300
"""Fragment payload of the legacy format."""

MAX_LEGACY_FRAGMENTS = 1 << 16
"""Fragments of one legacy message (85 MB): the legacy code accepted any 32-bit number and allocated it."""

MAX_THIN_NUMBER = 254
"""Nodes on thin links: their number has one byte; 0 and 255 are kept free."""

MAX_THIN_PARTS = 32
"""Parts of a message on thin links: as many as an acknowledgment has bits; bounds what one message can reserve."""

MAX_THIN_ITEMS = 32
"""Items of one frame of a thin link: bounds the work one frame can cause."""

MAX_THIN_HEARD = 48
"""Nodes that a presence lists as heard (5 B each): what one frame of 255 bytes has room for."""

MAX_THIN_FRAME_BYTES = 255
"""One frame of a thin link: LoRa's length field has one byte, and the other radios carry little more."""
