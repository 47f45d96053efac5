"""Find messages and settings without effect, as lines for the bridge's log. Pure.

To ROS, a name that is spelled differently from the daemon's topic is no error, but a topic that nothing reads.
"""

from __future__ import annotations

import logging
from typing import Container, Iterable, Mapping

from udp_mesh.bridges.names import ros_path, ros_word
from udp_mesh.bridges.reduction import Reduction
from udp_mesh.bridges.types import MeshTopic

log = logging.getLogger(__name__)

MAX_LISTED = 8


def unread_names(
    start: str, published: Iterable[str], read: Container[str], topics: Iterable[str], peers: Iterable[str]
) -> list[str]:
    """Lines about names that other programs publish and the bridge does not read, though they start as its own do."""
    declared = sorted(ros_path(topic) for topic in topics if not topic.startswith("bridge/"))
    text = "not-sent name={} expected a topic of the daemon ({}) after {}, or a robot that it knows ({}) and a topic"
    return [
        text.format(name, _listed(declared), start, _listed(sorted(map(ros_word, peers))))
        for name in sorted(published)
        if name.startswith(start) and name not in read
    ]


def settings_without_effect(
    configured: Iterable[str], reductions: Mapping[str, Reduction], topics: Mapping[str, MeshTopic]
) -> list[str]:
    """Lines about topics of the bridge's file that the daemon has not, or not as the file needs them."""
    lines = [
        "topic-unknown topic={} is in the bridge's file, but not one of the daemon's: {}".format(
            topic, _listed(sorted(each for each in topics if not each.startswith("bridge/")))
        )
        for topic in sorted(configured)
        if topic not in topics
    ]
    return lines + [
        "adapt-refused topic={} expected a reliable topic with keep_last = 1 at the daemon, found {}".format(
            topic, _delivery(topics[topic])
        )
        for topic in sorted(reductions)
        if reductions[topic].adapt and topic in topics and not topics[topic].is_adaptable
    ]


def _listed(names: list[str]) -> str:
    """`a, b`, shortened."""
    return ", ".join([*names[:MAX_LISTED], *(["..."] if len(names) > MAX_LISTED else [])]) or "none"


def _delivery(topic: MeshTopic) -> str:
    if not topic.reliable:
        return "best effort"
    return "reliable, keep_last = {}".format("none" if topic.keep_last is None else topic.keep_last)
