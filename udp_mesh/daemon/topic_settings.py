"""Topics in the daemon's configuration and in requests: tables -> `Topic`, with every problem reported."""

from __future__ import annotations

import dataclasses
import re

from udp_mesh.core.settings import MAX_COPIES, Log, Outbox, Topic
from udp_mesh.daemon.interface import RESERVED_PREFIX
from udp_mesh.daemon.neighbours import NODE_NAME, TOPIC_NAME, is_node_name, is_topic_name
from udp_mesh.daemon.toml_source import ConfigurationError, Problem, Source, Table


def problem_from(source: Source, error: ValueError) -> Problem:
    """Converts a ValueError of the settings into a problem, at its key's line if the text names one."""
    text = str(error)
    parts = re.fullmatch(r"(?P<key>[^:]+): (?:expected )?(?P<expected>.*?)(?:, found (?P<found>.*))?", text)
    if parts is None:
        return Problem(source.file, 1, "", "a valid configuration", text)
    path = tuple(parts["key"].split("."))
    return Problem(source.file, source.line(path), parts["key"], parts["expected"], parts["found"] or "otherwise")


def or_default(value: int | None, default: int) -> int:
    """The value, or the default if there is none."""
    return default if value is None else value


def read_topic(name: str, table: Table) -> Topic:
    """A topic from an entry of `[topics]` or from a request. Reports problems to the table's source."""
    good_name = False
    if name.startswith(RESERVED_PREFIX):
        table.source.report(table.path, f"a topic outside {RESERVED_PREFIX}", name)
    elif not is_topic_name(name):
        table.source.report(table.path, TOPIC_NAME, name)
    else:
        good_name = True
    default = Topic("default")
    topic = Topic(
        name="default",
        priority=or_default(table.integer("priority", default.priority, 0, 15), default.priority),
        reliable=table.boolean("reliable", default.reliable),
        keep_last=table.integer("keep_last", None, 1, 1 << 20),
        deadline_s=table.number("deadline_s", None, 0.001, 1e7),
        rate_limit_bytes_per_s=table.integer("rate_limit_bytes_per_s", None, 1, 1 << 40),
        compression=table.boolean("compression", default.compression),
        destinations=table.texts("destinations"),
        outbox=Outbox(table.choice("outbox", default.outbox.value, [member.value for member in Outbox])),
        outbox_bytes=or_default(table.integer("outbox_bytes", default.outbox_bytes, 0, 1 << 40), default.outbox_bytes),
        outbox_on_disk=table.boolean("outbox_on_disk", default.outbox_on_disk),
        repair=table.boolean("repair", default.repair),
        delta=table.boolean("delta", default.delta),
        always=table.boolean("always", default.always),
        thin=table.boolean("thin", default.thin),
        links=table.texts("links"),
        thin_period_s=table.number("thin_period_s", None, 0.1, 86_400.0),
        delta_bytes=or_default(table.integer("delta_bytes", default.delta_bytes, 1, 1 << 30), default.delta_bytes),
    )
    log = _read_log(table.table("log")) if table.has("log") else None
    table.finish()
    for destination in topic.destinations:
        if not is_node_name(destination):
            table.report("destinations", f"node names, each {NODE_NAME}", destination)
    if topic.outbox_on_disk and topic.outbox is Outbox.NONE:
        table.report("outbox_on_disk", 'outbox = "last" or "all" as well', topic.outbox_on_disk)
    try:
        return dataclasses.replace(topic, name=name if good_name else topic.name, log=log)
    except ValueError as error:
        _, _, text = str(error).partition(": expected ")
        expected, _, found = text.rpartition(", found ")
        table.source.report(table.path, expected, found)
        return topic


def _read_log(table: Table) -> Log:
    default = Log()
    log = Log(
        readers=table.texts("readers"),
        max_items=or_default(table.integer("max_items", None, 1, 1 << 24), default.max_items),
        max_bytes=or_default(table.integer("max_bytes", None, 1, 1 << 40), default.max_bytes),
        max_age_s=table.number("max_age_s", None, 1.0, 1e9),
        copies=or_default(table.integer("copies", None, 0, MAX_COPIES), default.copies),
    )
    table.finish()
    for reader in log.readers:
        if not is_node_name(reader):
            table.report("readers", f"node names, each {NODE_NAME}", reader)
    return log


def _unparsed(value: object) -> object:
    """A topic's field as it is written in a configuration."""
    match value:
        case Outbox():
            return value.value
        case Log():
            fields = ((entry.name, getattr(value, entry.name)) for entry in dataclasses.fields(value))
            return {name: list(item) if isinstance(item, tuple) else item for name, item in fields if item is not None}
        case _:
            return value


def topic_from_values(name: str, values: dict[str, object], current: Topic | None) -> Topic:
    """A topic from a request's fields; missing fields keep the value in `current`. Raises ConfigurationError."""
    merged: dict[str, object] = {}
    if current is not None:
        for entry in dataclasses.fields(Topic):
            value = getattr(current, entry.name)
            if entry.name != "name" and value is not None:
                merged[entry.name] = _unparsed(value)
        merged["destinations"], merged["links"] = list(current.destinations), list(current.links)
    merged.update(values)
    source = Source("command", {})
    topic = read_topic(name, Table({key: value for key, value in merged.items() if value is not None}, source, (name,)))
    if source.problems:
        raise ConfigurationError(source.problems)
    return topic
