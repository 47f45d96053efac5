"""The reserved topics that logs need, added to a node's settings: one for control messages, one per log."""

from __future__ import annotations

from dataclasses import replace

from udp_mesh.core.logs.messages import CONTROL_TOPIC, LOG_PREFIX, item_topic
from udp_mesh.core.settings import Settings, Topic

_ITEMS = f"{LOG_PREFIX}/"


def with_log_topics(settings: Settings) -> Settings:
    """The settings with the reserved topics of its logs. Items have their log's priority and rate limit; control
    messages are as urgent as the most urgent of them."""
    logs = [topic for topic in settings.topics if topic.log is not None]
    if not logs:
        return settings
    control = Topic(CONTROL_TOPIC, priority=min(topic.priority for topic in logs), always=True)
    items = tuple(replace(topic, name=item_topic(topic.name), log=None, always=True) for topic in logs)
    return replace(settings, topics=(*settings.topics, control, *items))


def is_log_traffic(topic: str) -> bool:
    """Whether this is one of the reserved topics."""
    return topic == CONTROL_TOPIC or topic.startswith(_ITEMS)


def log_of(topic: str) -> str | None:
    """The log whose items travel on this topic, if it is one of those."""
    return topic[len(_ITEMS) :] if topic.startswith(_ITEMS) else None
