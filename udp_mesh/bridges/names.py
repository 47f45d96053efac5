"""Names of the fielded system: mesh peer and topic <-> ROS name. Pure.

To send to one robot, a node publishes on `/<self>/mesh_comm/<peer>/<topic>`, to all on `/<self>/mesh_comm/<topic>`;
what arrives comes out on `/<source>/mesh_comm/<self>/<topic>`. So nothing that came in has a name that goes out.
"""

from __future__ import annotations

import re
from typing import Iterable, NamedTuple

PREFIX = "mesh_comm"
_NOT_ROS = re.compile(r"[^A-Za-z0-9_]")


class Route(NamedTuple):
    """Where a message of one ROS name goes: a mesh topic, to one peer or (None) to the topic's destinations."""

    topic: str
    peer: str | None


def ros_word(name: str) -> str:
    """A mesh name as one part of a ROS name: `ugv-1` is `ugv_1`, `3d` is `n3d` (a part starts with a letter)."""
    word = _NOT_ROS.sub("_", name) or "_"
    return word if word[0].isalpha() else "n" + word


def ros_path(topic: str) -> str:
    """A mesh topic as the end of a ROS name, part by part; a leading slash is dropped."""
    return "/".join(ros_word(part) for part in topic.split("/") if part) or "_"


def inbound_name(own: str, source: str, topic: str) -> str:
    """Where a message from `source` comes out."""
    return "/{}/{}/{}/{}".format(ros_word(source), PREFIX, ros_word(own), ros_path(topic))


def outbound_name(own: str, route: Route) -> str:
    """Where a node publishes what shall take this route."""
    peer = "" if route.peer is None else ros_word(route.peer) + "/"
    return "/{}/{}/{}{}".format(ros_word(own), PREFIX, peer, ros_path(route.topic))


def routes(own: str, topics: Iterable[str], peers: Iterable[str]) -> dict[str, Route]:
    """Every ROS name to listen on. Where a broadcast topic `x/y` and topic `y` to peer `x` share a name, the peer wins.

    A robot whose name reads like our own in ROS is left out: its messages could not be told from ours.
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
    """The route of a published name whose topic nobody declared; None for a name outside our own prefix."""
    start = "/{}/{}/".format(ros_word(own), PREFIX)
    if not name.startswith(start):
        return None
    first, _, rest = name[len(start) :].partition("/")
    for peer in peers:
        if rest and ros_word(peer) == first:
            return Route(rest, peer)
    return Route(name[len(start) :], None) if first else None


class ListedTopic(NamedTuple):
    """One entry of the fielded parameter `topic_list`."""

    topic: str
    priority: int


def parse_topic_list(entries: Iterable[object]) -> tuple[list[ListedTopic], list[str]]:
    """Entries `priority|pkg/Type|topic` -> topics, and a sentence for each entry that is none.

    The type is not needed: every message says its own. Priorities beyond 15 become 15, the mesh's last level.
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
