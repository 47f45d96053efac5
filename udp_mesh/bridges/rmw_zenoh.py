"""How ROS 2 uses Zenoh through `rmw_zenoh`: a topic's key, and the liveliness tokens the ROS graph is made of. Pure.

A topic's key is `<domain>/<topic>/<type>/<type hash>`. Each publisher has a token
`@ros2_lv/<domain>/<session>/<node>/<entity>/MP/<enclave>/<namespace>/<node name>/<topic>/<type>/<type hash>/<qos>`,
with `%` for every slash inside a part. Tokens cross the mesh whole, so type hash and QoS do. The QoS is
`reliability:durability:history,depth:deadline:lifespan:liveliness`: numbers of rmw's enums, empty for defaults.

A publisher with transient local durability answers queries below `<its key>/@adv/` with its last samples. A message's
attachment ends with its publisher's id of 16 bytes. (ros2/rmw_zenoh: docs/design.md, detail/liveliness_utils.hpp.)

`TokenExchange` keeps the tokens of each side known on the other: what is announced is always the full set, so that a
lost or doubled announcement does no harm; a token that some bridge set up is nobody's own and is not announced again.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from typing import NamedTuple

ADMIN = "@ros2_lv"
CARRIED = "udp_mesh/carried"
"""Key prefix of the tokens by which a bridge says which tokens it set up for robots of the mesh."""
HISTORY = "@adv/**"
"""Below a key: where publishers answer with what they keep."""
TRANSIENT_LOCAL, KEEP_ALL = "1", "2"
DEFAULT_DEPTH = 42
"""What `rmw_zenoh` takes where none is given."""
MAX_DEPTH = 1000
"""Samples kept for one publisher: a peer's token may ask for any number."""
PUBLISHER_ID_BYTES = 16
MAX_TOKENS = 4096
"""Tokens of one robot: a node has some dozens of topics; more is a peer inventing names."""
MAX_DIGESTS = 1 << 16
"""Samples remembered so that none is put twice: more than all publishers that keep some can tell again at once."""
MAX_TOKEN_BYTES = 1024
MAX_ANNOUNCEMENT_BYTES = 4 << 20


class AnnouncementError(ValueError):
    """These bytes announce no tokens; says why."""


def topic_keys(topic: str, domain: int) -> str:
    """The key expression of a ROS 2 topic of any type."""
    return "{}/{}/*/*".format(domain, topic.strip("/"))


def publisher_tokens(topic: str, domain: int) -> str:
    """The key expression of the tokens of a topic's publishers."""
    name = "%" + topic.strip("/").replace("/", "%")
    return "{}/{}/*/*/*/MP/*/*/*/{}/*/*/*".format(ADMIN, domain, name)


def kept_samples(token: str) -> tuple[str, int]:
    """A publisher's key, and how many samples it keeps for late subscribers: 0 where it is not transient local."""
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
    """Tells apart the publishers of one key; an attachment that is none of `rmw_zenoh`'s tells nothing."""
    return attachment[-PUBLISHER_ID_BYTES:] if attachment is not None else b""


def carried_key(session: str, token: str) -> str:
    """The companion of a token that this session set up for a robot of the mesh."""
    return "{}/{}/{}".format(CARRIED, session, token[1:])


def carried_token(key: str) -> str:
    """The token whose companion this is."""
    return "@" + key[len(CARRIED) + 1 :].partition("/")[2]


class TokenChange(NamedTuple):
    """What to declare and what to take back on our side."""

    declare: list[str]
    withdraw: list[str]


class TokenExchange:
    """Tokens on our side, and those of each robot of the mesh."""

    def __init__(self) -> None:
        self._local: set[str] = set()
        self._carried: set[str] = set()
        self._announced: dict[str, set[str]] = {}
        self._declared: set[str] = set()
        self._depths: dict[str, int] = {}

    def on_token(self, token: str, alive: bool) -> None:
        """A token came or went on our side."""
        (self._local.add if alive else self._local.discard)(token)

    def on_companion(self, key: str, alive: bool) -> None:
        """A companion came or went: its token is some bridge's."""
        (self._carried.add if alive else self._carried.discard)(carried_token(key))

    def depth(self, key: str) -> int:
        """How many samples each publisher of this key on other robots keeps for late subscribers; 0: none."""
        return self._depths.get(key, 0)

    def keeping_keys(self) -> list[str]:
        """Keys of our side's own publishers that keep samples."""
        own = (kept_samples(token) for token in self._local - self._carried - self._declared)
        return sorted({key for key, depth in own if depth})

    def announcement(self, *, answer: bool = False) -> bytes:
        """All tokens that are our side's own. `answer` asks who hears it for theirs."""
        own = sorted(self._local - self._carried - self._declared)
        return json.dumps({"tokens": own[:MAX_TOKENS], "answer": answer}).encode()

    def on_announcement(self, source: str, announcement: bytes) -> tuple[TokenChange, bool]:
        """A robot announced its tokens; also whether it asks for ours. Raises AnnouncementError."""
        self._announced[source], answer = _read(announcement)
        return self._change(), answer

    def on_robot_gone(self, source: str) -> TokenChange:
        """A robot is away: so are its publishers."""
        self._announced.pop(source, None)
        return self._change()

    def _change(self) -> TokenChange:
        wanted: set[str] = set().union(*self._announced.values())
        # What is our own here needs no copy; what we set up ourselves is also seen here.
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
    """What came of publishers that keep samples: so that what is told again is put once."""

    def __init__(self) -> None:
        self._digests: OrderedDict[bytes, None] = OrderedDict()

    def is_new(self, key: str, attachment: bytes | None, payload: bytes) -> bool:
        """Notes a sample; False where it came before."""
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
