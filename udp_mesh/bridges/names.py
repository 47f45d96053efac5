"""Names of the legacy system: mesh peer and topic <-> ROS name. Pure.

A node publishes on `/<self>/mesh_comm/<peer>/<topic>` for one robot and on `/<self>/mesh_comm/<topic>` for all;
received messages are published on `/<source>/mesh_comm/<self>/<topic>`, which never matches an outgoing name.
"""

from __future__ import annotations

import re
from typing import Iterable, NamedTuple

PREFIX = "mesh_comm"
_NOT_ROS = re.compile(r"[^A-Za-z0-9_]")


class Route(NamedTuple):
    """Destination of messages on one ROS name: a mesh topic, and one peer or (None) the topic's destinations."""

    topic: str
    peer: str | None


def ros_word(name: str) -> str:
    """A mesh name as one segment of a ROS name: `ugv-1` is `ugv_1`, `3d` is `n3d` (a segment starts with a letter)."""
    word = _NOT_ROS.sub("_", name) or "_"
    return word if word[0].isalpha() else "n" + word


def ros_path(topic: str) -> str:
    """A mesh topic as the end of a ROS name, segment by segment; a leading slash is dropped."""
    return "/".join(ros_word(part) for part in topic.split("/") if part) or "_"


def inbound_name(own: str, source: str, topic: str) -> str:
    """The ROS name on which messages from `source` are published."""
    return "/{}/{}/{}/{}".format(ros_word(source), PREFIX, ros_word(own), ros_path(topic))


def outbound_name(own: str, route: Route) -> str:
    """The ROS name on which local nodes publish for this route."""
    peer = "" if route.peer is None else ros_word(route.peer) + "/"
    return "/{}/{}/{}{}".format(ros_word(own), PREFIX, peer, ros_path(route.topic))


def own_prefix(own: str) -> str:
    """The prefix of the ROS names on which local nodes publish, without the last slash."""
    return "/{}/{}".format(ros_word(own), PREFIX)


def routes(own: str, topics: Iterable[str], peers: Iterable[str]) -> dict[str, Route]:
    """Every ROS name to subscribe to. If a broadcast topic `x/y` and topic `y` to peer `x` share a name, the peer wins.

    A robot whose ROS name equals our own is left out, since its messages could not be distinguished from ours.
    """
    found: dict[str, Route] = {}
    names = list(topics)
    for topic in names:
        route = Route(topic, None)
        found[outbound_name(own, route)] = route
    for peer in sorted(peers):
        if ros_word(peer) != ros_word(own):
            for topic in names:
                route = Route(topic, peer)
                found[outbound_name(own, route)] = route
    return found


def undeclared_route(own: str, name: str, peers: Iterable[str]) -> Route | None:
    """The route of a published name whose topic is not declared; None for a name outside our own prefix."""
    start = own_prefix(own) + "/"
    if not name.startswith(start):
        return None
    first, _, rest = name[len(start) :].partition("/")
    for peer in peers:
        if rest and ros_word(peer) == first:
            return Route(rest, peer)
    return Route(name[len(start) :], None) if first else None


class ListedTopic(NamedTuple):
    """One entry of the legacy parameter `topic_list`."""

    topic: str
    priority: int


def parse_topic_list(entries: Iterable[object]) -> tuple[list[ListedTopic], list[str]]:
    """Entries `priority|pkg/Type|topic` -> topics, and a description of each invalid entry.

    The type is ignored: every message carries its own. Priorities above 15 become 15, the least urgent level.
    """
    found: list[ListedTopic] = []
    problems: list[str] = []
    for place, entry in enumerate(entries):
        parts = [part.strip() for part in str(entry).split("|")]
        if len(parts) != 3 or not parts[0].isdecimal() or not parts[2].strip("/") or " " in parts[2]:
            problems.append("topic_list[{}]: expected 'priority|pkg/Type|topic', found {!r}".format(place, entry))
            continue
        found.append(ListedTopic(parts[2].strip("/"), min(int(parts[0]), 15)))
    return found, problems
