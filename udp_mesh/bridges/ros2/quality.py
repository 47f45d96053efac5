"""ROS 2 quality of service and type hash <-> the checksum word of a type field (`types`). Pure.

`reliable:transient_local:10:RIHS01_df66...`: reliability, durability, depth, and the type's hash if ROS reports it
(since Iron). A receiver publishes with the quality the source offered, and only if its own type has the same hash.
"""

from __future__ import annotations

import re
from typing import Dict, Iterable, Mapping, NamedTuple

RELIABILITIES = ("reliable", "best_effort")
DURABILITIES = ("volatile", "transient_local")
MAX_DEPTH = 10_000
"""Maximum history depth per topic: bounds what a peer can make a publisher hold."""
_TYPE_HASH = re.compile(r"(RIHS[0-9]{2}_[0-9a-f]{64})?")


class Quality(NamedTuple):
    """The quality a publisher offers. `type_hash` is "" if it is not known."""

    reliability: str = "reliable"
    durability: str = "volatile"
    depth: int = 10
    type_hash: str = ""

    @property
    def latched(self) -> bool:
        """Whether late joiners get the last messages."""
        return self.durability == "transient_local"


def quality_text(quality: Quality) -> str:
    return "{}:{}:{}:{}".format(*quality)


def parse_quality(text: str) -> Quality | None:
    """Parses a checksum word; None if it is not a quality."""
    parts = text.split(":")
    if len(parts) != 4 or parts[0] not in RELIABILITIES or parts[1] not in DURABILITIES:
        return None
    if not (parts[2].isascii() and parts[2].isdigit()) or not 1 <= int(parts[2]) <= MAX_DEPTH:
        return None
    return Quality(parts[0], parts[1], int(parts[2]), parts[3]) if _TYPE_HASH.fullmatch(parts[3]) else None


def history_depth(text: str) -> int:
    """How many messages of a latched publisher late joiners get: in ROS 2 its depth, in ROS 1 one."""
    quality = parse_quality(text)
    return quality.depth if quality is not None and quality.latched else 1


def common(qualities: Iterable[Quality]) -> Quality:
    """The quality that all publishers of a topic offer: a subscription that requests more than a publisher offers does
    not receive from it. Requires at least one quality."""
    found = list(qualities)
    return found[0]._replace(
        reliability=max((quality.reliability for quality in found), key=RELIABILITIES.index),
        durability=min((quality.durability for quality in found), key=DURABILITIES.index),
        depth=max(quality.depth for quality in found),
    )


def in_order_of_arrival(known: Mapping[bytes, str], listed: Mapping[bytes, str]) -> Dict[bytes, str]:
    """The types of the publishers (by their ids) that the graph lists, in no order of its own: first those that are
    known. A publisher that was killed is still listed for some seconds beside the one that replaces it."""
    kept = {publisher: listed[publisher] for publisher in known if publisher in listed}
    return {**kept, **listed}


def ros2_name(name: str) -> str:
    """A ROS name as a valid ROS 2 name, which has no repeated underscores."""
    return re.sub("_{2,}", "_", name)
