"""How ROS 2 uses Zenoh through `rmw_zenoh`: topic keys, and the liveliness tokens of the ROS graph. Pure.

A topic's key is `<domain>/<topic>/<type>/<type hash>`. Each publisher has a token
`@ros2_lv/<domain>/<session>/<node>/<entity>/MP/<enclave>/<namespace>/<node name>/<topic>/<type>/<type hash>/<qos>`,
with `%` for every slash inside a part. Tokens cross the mesh unchanged, with type hash and QoS. The QoS is
`reliability:durability:history,depth:deadline:lifespan:liveliness`: numbers of rmw's enums, empty for defaults.

A publisher with transient local durability answers queries below `<its key>/@adv/` with its last samples. A message's
attachment ends with its publisher's id of 16 bytes. (ros2/rmw_zenoh: docs/design.md, detail/liveliness_utils.hpp.)

`TokenExchange` announces the tokens of each side to the other. An announcement is always the full set, so loss and
duplication are harmless. A token declared by a bridge does not belong to its side and is not announced again.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from typing import NamedTuple

ADMIN = "@ros2_lv"
CARRIED = "udp_mesh/carried"
"""Key prefix of the companion tokens, which mark the tokens a bridge declared for robots of the mesh."""
HISTORY = "@adv/**"
"""Suffix of a key at which publishers answer with their cached samples."""
TRANSIENT_LOCAL, KEEP_ALL = "1", "2"
DEFAULT_DEPTH = 42
"""The depth `rmw_zenoh` uses if none is given."""
MAX_DEPTH = 1000
"""Maximum number of samples cached per publisher: a peer's token may ask for any number."""
PUBLISHER_ID_BYTES = 16
MAX_TOKENS = 4096
"""Tokens per robot: a node has some dozens of topics, but a peer can invent names."""
MAX_DIGESTS = 1 << 16
"""Samples remembered for deduplication: more than all caching publishers can send again at once."""
MAX_TOKEN_BYTES = 1024
MAX_ANNOUNCEMENT_BYTES = 4 << 20


class AnnouncementError(ValueError):
    """These bytes are not a valid announcement."""


def topic_keys(topic: str, domain: int) -> str:
    """The key expression of a ROS 2 topic with any type."""
    return "{}/{}/*/*".format(domain, topic.strip("/"))


def publisher_tokens(topic: str, domain: int) -> str:
    """The key expression of the tokens of a topic's publishers."""
    name = "%" + topic.strip("/").replace("/", "%")
    return "{}/{}/*/*/*/MP/*/*/*/{}/*/*/*".format(ADMIN, domain, name)


def kept_samples(token: str) -> tuple[str, int]:
    """A publisher's key and the number of samples it caches for late joiners: 0 unless it is transient local."""
    parts = token.split("/")
    if len(parts) != 13 or parts[5] != "MP":
        return "", 0
    key = "/".join((parts[1], parts[9].replace("%", "/").strip("/"), parts[10], parts[11]))
    quality = parts[12].split(":")
    if len(quality) < 3 or quality[1] != TRANSIENT_LOCAL:
        return key, 0
    history, _, depth = quality[2].partition(",")
    if history == KEEP_ALL:
        return key, MAX_DEPTH
    number = int(depth) if depth.isascii() and depth.isdigit() else DEFAULT_DEPTH
    return key, min(number or DEFAULT_DEPTH, MAX_DEPTH)


def publisher_id(attachment: bytes | None) -> bytes:
    """Distinguishes the publishers of one key; other attachments than `rmw_zenoh`'s yield an arbitrary id."""
    return attachment[-PUBLISHER_ID_BYTES:] if attachment is not None else b""


def carried_key(session: str, token: str) -> str:
    """The companion of a token that this session declared for a robot of the mesh."""
    return "{}/{}/{}".format(CARRIED, session, token[1:])


def carried_token(key: str) -> str:
    """The token of this companion."""
    return "@" + key[len(CARRIED) + 1 :].partition("/")[2]


class TokenChange(NamedTuple):
    """Tokens to declare and to withdraw on our side."""

    declare: list[str]
    withdraw: list[str]


class TokenExchange:
    """Tokens of our side, and those of each robot of the mesh."""

    def __init__(self) -> None:
        self._local: set[str] = set()
        self._carried: set[str] = set()
        self._announced: dict[str, set[str]] = {}
        self._declared: set[str] = set()
        self._depths: dict[str, int] = {}

    def on_token(self, token: str, alive: bool) -> None:
        """A token was declared or withdrawn on our side."""
        (self._local.add if alive else self._local.discard)(token)

    def on_companion(self, key: str, alive: bool) -> None:
        """A companion was declared or withdrawn: its token is a bridge's."""
        (self._carried.add if alive else self._carried.discard)(carried_token(key))

    def depth(self, key: str) -> int:
        """Samples that each publisher of this key on other robots caches for late joiners; 0: none."""
        return self._depths.get(key, 0)

    def keeping_keys(self) -> list[str]:
        """Keys of our side's own publishers that cache samples."""
        own = (kept_samples(token) for token in self._local - self._carried - self._declared)
        return sorted({key for key, depth in own if depth})

    def announcement(self, *, answer: bool = False) -> bytes:
        """All tokens of our side. `answer` requests the receiver's announcement."""
        own = sorted(self._local - self._carried - self._declared)
        return json.dumps({"tokens": own[:MAX_TOKENS], "answer": answer}).encode()

    def on_announcement(self, source: str, announcement: bytes) -> tuple[TokenChange, bool]:
        """Handles a robot's announcement; also returns whether it requests ours. Raises AnnouncementError."""
        self._announced[source], answer = _read(announcement)
        return self._change(), answer

    def on_robot_gone(self, source: str) -> TokenChange:
        """A robot went offline: withdraws the tokens of its publishers."""
        self._announced.pop(source, None)
        return self._change()

    def _change(self) -> TokenChange:
        wanted: set[str] = set().union(*self._announced.values())
        # Tokens of our own side need no copy; tokens declared by this bridge also show up as local.
        wanted -= self._local - self._declared
        change = TokenChange(sorted(wanted - self._declared), sorted(self._declared - wanted))
        self._declared = wanted
        self._depths = {}
        for token in wanted:
            key, depth = kept_samples(token)
            self._depths[key] = max(depth, self._depths.get(key, 0))
        return change


def _read(data: bytes) -> tuple[set[str], bool]:
    if len(data) > MAX_ANNOUNCEMENT_BYTES:
        raise AnnouncementError("expected at most {} bytes".format(MAX_ANNOUNCEMENT_BYTES))
    try:
        fields = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise AnnouncementError("expected JSON: {}".format(error)) from error
    tokens = fields.get("tokens") if isinstance(fields, dict) else None
    if not isinstance(tokens, list) or len(tokens) > MAX_TOKENS:
        raise AnnouncementError("tokens: expected a list of at most {}".format(MAX_TOKENS))
    for token in tokens:
        good = isinstance(token, str) and len(token) <= MAX_TOKEN_BYTES and token.startswith(ADMIN + "/")
        if not good or any(sign in token for sign in "*$?#") or "//" in token or token.endswith("/"):
            raise AnnouncementError("expected a token below {}, found {!r}".format(ADMIN, token))
    return set(tokens), fields.get("answer") is True


class SampleDeduplicator:
    """Remembers samples of caching publishers, so that a sample sent again is published once."""

    def __init__(self) -> None:
        self._digests: OrderedDict[bytes, None] = OrderedDict()

    def is_new(self, key: str, attachment: bytes | None, payload: bytes) -> bool:
        """Remembers a sample; False if it was received before."""
        digest = hashlib.blake2b(digest_size=16)
        for part in (key.encode(), attachment or b"", payload):
            digest.update(len(part).to_bytes(8, "big"))
            digest.update(part)
        name = digest.digest()
        known = name in self._digests
        self._digests.pop(name, None)
        self._digests[name] = None
        if len(self._digests) > MAX_DIGESTS:
            self._digests.popitem(last=False)
        return not known
