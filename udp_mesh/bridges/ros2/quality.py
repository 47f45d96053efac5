"""ROS 2's quality of service as the checksum word of a type field (`types`), and back. Pure.

`reliable:transient_local:10`: reliability, durability, depth. A receiver publishes with what the source offered.
"""

from __future__ import annotations

from typing import NamedTuple

RELIABILITIES = ("reliable", "best_effort")
DURABILITIES = ("volatile", "transient_local")
MAX_DEPTH = 10_000
"""History kept per topic: bounds what a peer can make a publisher hold."""


class Quality(NamedTuple):
    """What a publisher offers."""

    reliability: str = "reliable"
    durability: str = "volatile"
    depth: int = 10

    @property
    def latched(self) -> bool:
        """Late subscribers get the last messages."""
        return self.durability == "transient_local"


def quality_text(quality: Quality) -> str:
    return "{}:{}:{}".format(*quality)


def parse_quality(text: str) -> Quality | None:
    """The quality in a checksum word; None where it is none."""
    parts = text.split(":")
    if len(parts) != 3 or parts[0] not in RELIABILITIES or parts[1] not in DURABILITIES:
        return None
    if not (parts[2].isascii() and parts[2].isdigit()) or not 1 <= int(parts[2]) <= MAX_DEPTH:
        return None
    return Quality(parts[0], parts[1], int(parts[2]))
