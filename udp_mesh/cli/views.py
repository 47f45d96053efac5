"""Formats the daemon's replies for people. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from udp_mesh.cli.output import counted, duration, milliseconds, rate, size, table
from udp_mesh.cli.thin_view import thin_view

Json = dict[str, Any]

NO_ANSWER_AFTER_S = 3.0
"""Shorter outages are not shown."""


def peers_view(peers: list[Json]) -> str:
    """One line per peer, then one per priority with waiting messages."""
    if not peers:
        return "no peers yet"
    rows = [
        [
            peer["name"] + (" (legacy)" if peer["legacy"] else ""),
            *_state(peer),
            peer["address"] or "-",
            _path(peer),
            milliseconds(peer["round_trip_s"]),
            f"{peer['loss'] * 100:.1f} %",
            rate(peer["sent_bits_per_s"]),
            rate(peer["received_bits_per_s"]),
            rate(peer["capacity_bits_per_s"]),
            # daemons of earlier versions do not tell
            (peer.get("trend") or {}).get("direction", "-"),
            str(sum(queue["messages"] for queue in peer["queues"]) + peer["outbox_messages"]),
        ]
        for peer in peers
    ]
    head = ["peer", "state", "for", "address", "link", "rtt", "loss", "sends", "receives", "capacity"]
    head += ["trend", "waiting"]
    lines = [table(head, rows)]
    waiting = [
        [
            peer["name"],
            str(queue["priority"]),
            str(queue["messages"]),
            size(queue["bytes"]),
            duration(queue["oldest_s"]),
            duration(queue["starved_s"]),
            duration(queue["held_s"]),
            "-" if queue.get("drained_in_s") is None else duration(queue["drained_in_s"]),
        ]
        for peer in peers
        for queue in peer["queues"]
        if queue["messages"]
    ]
    if waiting:
        lines += [
            "",
            table(["waiting for", "priority", "messages", "bytes", "oldest", "starved", "held", "sent in"], waiting),
        ]
    left = [[peer["name"], *step] for peer in peers for step in _available(peer)]
    if left:
        lines += ["", table(["left for", "priority", "rate"], left)]
    radio = [_radio(peer["name"], peer["radio"]) for peer in peers if peer.get("radio")]
    if radio:
        head = ["radio path to", "radio", "next hop", "signal", "margin", "bottleneck", "quality", "trend", "age"]
        lines += ["", table(head, radio)]
    return "\n".join(lines)


def _path(peer: Json) -> str:
    """The link, and the relays on the way."""
    via = peer.get("via") or ()
    return f"{peer['link'] or '-'}{' through ' if via else ''}{' > '.join(via)}"


def _available(peer: Json) -> list[tuple[str, str]]:
    """(priorities, rate) where the rate that a message would get depends on its priority; else it is the capacity."""
    available = peer.get("available_bits_per_s") or ()
    starts = [priority for priority, bits_per_s in enumerate(available) if bits_per_s not in available[:priority][-1:]]
    if len(starts) < 2:
        return []
    ends = [start - 1 for start in starts[1:]] + [len(available) - 1]
    return [
        (str(start) if start == end else f"{start} to {end}", rate(available[start]))
        for start, end in zip(starts, ends, strict=True)
    ]


def _radio(peer: str, radio: Json) -> list[str]:
    """A collector's report of the path to a peer."""
    return [
        peer,
        radio["radio"],
        radio["next_hop"],
        _decibels(radio["signal_dbm"], "dBm"),
        _decibels(radio["margin_db"], "dB"),
        rate(radio["bottleneck_bits_per_s"]),
        "-" if radio["quality"] is None else f"{radio['quality'] * 100:.0f} %",
        (radio["trend"] or {}).get("direction", "-"),
        duration(radio["age_s"]),
    ]


def _decibels(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.0f} {unit}"


def _state(peer: Json) -> tuple[str, str]:
    """State in a word, and its duration."""
    unanswered_for_s = peer["unanswered_for_s"] or 0.0
    if peer["online"] and not peer["one_way"] and unanswered_for_s >= NO_ANSWER_AFTER_S:
        return "NO ANSWER", duration(unanswered_for_s)
    word = "ONE WAY" if peer["one_way"] else "online" if peer["online"] else "OFFLINE"
    return word, duration(peer["online_for_s"] if peer["online"] else peer["heard_ago_s"])


def status_view(status: Json) -> str:
    """The whole status page."""
    conditions = status["conditions"]
    counters = conditions["counters"]
    protection = "UNKEYED: no protection" if status["unkeyed"] else f"key {' and '.join(status['keys'])}"
    lines = [
        f"{conditions['name']}  udp-mesh {status['version']}, wire version {status['wire_version']}, "
        f"up {duration(status['uptime_s'])}, {protection}, window {status['window']}",
        "",
    ]
    if status["links"]:
        rows = [
            [
                link["name"],
                link["address"],
                link["broadcast"] or "neighbors only",
                str(link["mtu"]),
                str(link["lost_on_send"]),
            ]
            for link in status["links"]
        ]
        lines.append(table(["link", "address", "broadcast", "mtu", "unsendable"], rows))
    else:
        lines.append("NO LINK: no configured interface is up with an address")
    lines += [f"link {name} FAILED: {reason}" for name, reason in status["link_failures"].items()]
    lines += [
        f"link {refusal['link']} CANNOT SEND to {refusal['to']}: {refusal['reason']} "
        f"({counted(refusal['datagrams'], 'datagram')}, last {duration(refusal['last_ago_s'])} ago)"
        for refusal in status["refusals"]
    ]
    lines += ["", peers_view(conditions["peers"])]
    mtus = {link["name"]: link["mtu"] for link in status["links"]}
    lines += [
        f"the path to {peer['name']} carries packets of {peer['path_mtu_bytes']} bytes at most, link {peer['link']} "
        f"{mtus[peer['link']]}"
        for peer in conditions["peers"]
        # Daemons of earlier versions do not tell; a relayed path has no link of its own.
        if peer.get("path_mtu_bytes") and peer["path_mtu_bytes"] < mtus.get(peer["link"], 0)
    ]
    radio = conditions.get("radio")
    if radio and radio["problem"]:
        lines.append(f"RADIO: {radio['problem']}")
    lines += [
        f"{stranger['name']} at {stranger['address']} on {stranger['link']} is heard but DOES NOT HEAR US, "
        f"for {duration(stranger['heard_for_s'])}"
        for stranger in conditions["strangers"]
    ]
    if status.get("relaying"):
        lines += relays_view(status["relaying"])
    if status.get("thin"):
        lines += thin_view(status["thin"])
    if status.get("positions"):
        rows = [
            [
                place["name"],
                *("-" if place[axis] is None else f"{place[axis]:.1f}" for axis in ("x_m", "y_m", "z_m")),
                place["frame"],
                duration(place["age_s"]),
            ]
            for place in status["positions"]
        ]
        lines += ["", table(["position", "x, m", "y, m", "z, m", "frame", "age"], rows)]
    lines.append("")
    lines.append(
        f"channel: {rate(conditions['sent_bits_per_s'])} sent here, {rate(conditions['heard_bits_per_s'])} in total"
    )
    lines.append(
        f"messages: {counters['messages_sent']} sent, {counters['messages_delivered']} delivered, "
        f"{counters['messages_expired']} expired, {counters['messages_peer_lost']} peer lost, "
        f"{counters['messages_received']} received; {size(conditions['queued_bytes'])} queued"
    )
    lines.append(
        f"datagrams: {counters['datagrams_sent']} sent, {counters['datagrams_received']} received; fragments: "
        f"{counters['fragments_retransmitted']} retransmitted, {counters['duplicates_received']} duplicates"
    )
    saved_messages = sum(peer["saved_messages"] for peer in conditions["peers"])
    if saved_messages:
        saved_bytes = sum(peer["saved_bytes"] for peer in conditions["peers"])
        saved = counted(saved_messages, "message")
        lines.append(f"not sent because no program there wants it: {saved}, {size(saved_bytes)}")
    if dropped := _drops(counters):
        lines.append(f"dropped: {_listed(dropped)}")
    if status["recording"]:
        lines.append(f"recording to {status['recording']['path']} ({size(status['recording']['bytes'])})")
    return "\n".join(lines)


def _drops(counters: Json) -> dict[str, int]:
    """Cause -> number of datagrams dropped for it; those that occurred."""
    return {name.removeprefix("dropped_"): n for name, n in counters.items() if name.startswith("dropped_") and n}


def _listed(drops: Mapping[str, int]) -> str:
    return ", ".join(f"{number} {cause.replace('_', ' ')}" for cause, number in drops.items())


def relays_view(relaying: Json) -> list[str]:
    """One line per node behind relays, and what this node passes on."""
    lines: list[str] = []
    rows = [
        [
            route["name"],
            " > ".join(route["via"]),
            str(route["hops"]),
            f"{route['cost']:.1f}",
            "NO COMMON KEY" if not route["common_key"] else "in use" if route["in_use"] else "not in use",
            ", ".join(route["readable_by"]) or "none",
        ]
        for route in relaying["routes"]
    ]
    if rows:
        lines += ["", table(["relayed", "through", "links", "cost", "state", "relays with our key"], rows)]
    lines += [
        f"relay {neighbour['name']} DOES NOT ANSWER"
        for neighbour in relaying["neighbours"]
        if neighbour["relays"] and neighbour["unanswered"]
    ]
    if relaying["relays"]:
        counters = relaying["counters"]
        causes = _drops(counters)
        dropped = sum(causes.values())
        by_cause = f" ({_listed(causes)})" if dropped else ""
        lines += [
            "",
            f"relay: {counted(counters['passed_on'], 'datagram')} forwarded ({size(counters['passed_on_bytes'])}), "
            f"{dropped} dropped{by_cause}, {size(relaying['queued_bytes'])} queued",
        ]
    return lines


def topics_view(reply: Json) -> str:
    """One line per topic, most urgent first."""
    rows = [
        [
            topic["name"],
            str(topic["priority"]) if topic["configured"] else "-",
            _delivery(topic) if topic["configured"] else "not configured",
            f"{topic['sent_messages']}",
            size(topic["sent_bytes"]),
            f"{topic['received_messages']}",
            size(topic["received_bytes"]),
        ]
        for topic in reply["topics"]
    ]
    undeclared = reply["undeclared"]
    foot = "other topics are refused" if undeclared is None else f"other topics: priority {undeclared['priority']}"
    if not rows:
        return f"no topic is configured; {foot}"
    lines = [table(["topic", "priority", "delivery", "sent", "", "received", ""], rows)]
    differences = [
        [
            topic["name"],
            str(versions["whole_sent"]),
            str(versions["differences_sent"]),
            size(versions["payload_bytes_sent"]),
            size(versions["body_bytes_sent"]),
            str(versions["whole_received"]),
            str(versions["differences_received"]),
            str(versions["bases_lost"] + versions["bases_missing"] + versions["damaged"]),
        ]
        for topic in reply["topics"]
        if (versions := topic.get("versions")) is not None
    ]
    if differences:
        head = ["versions of", "sent whole", "differences", "bytes", "on the wire", "received whole", "differences"]
        lines += ["", table([*head, "sent again"], differences), ""]
    return "\n".join([*lines, foot])


def logs_view(reply: Json) -> str:
    """One line per log: what is here, and who has it or lacks it."""
    rows = [
        [
            log["topic"],
            log["source"],
            f"{log['received_items']} of {log['known_items']}",
            str(log["held_items"]),
            size(log["held_bytes"]),
            str(log["waiting_items"]),
            ", ".join(f"{holder['name']} {holder['items']}" for holder in log["holders"]) or "-",
            ", ".join(f"{reader} lacks {count}" for reader, count in log["missing_readers"].items()) or "-",
        ]
        for log in reply["logs"]
    ]
    lines = [f"NOT ON DISK: {reply['disk']}"] if reply["disk"] else []
    if not rows:
        return "\n".join([*lines, "no log has items yet"])
    head = ["log", "source", "received", "on disk", "", "not taken", "others have", "missing"]
    return "\n".join([*lines, table(head, rows)])


def subscriptions_view(reply: Json) -> str:
    """Local subscriptions, then one line per peer and pattern, then the traffic that was not sent."""
    lines = [] if reply["selective"] else ["NOT SELECTIVE: peers are sent everything (selective = false)"]
    rows = [["here", entry["topics"], *_bounds(entry)] for entry in reply["read_here"]] or [["here", "nothing", "", ""]]
    for peer in reply["peers"]:
        if peer["reads"] is None:
            rows.append([peer["name"], "everything" if peer["known"] else "not known: is sent everything", "", ""])
        else:
            read = [[peer["name"], entry["topics"], *_bounds(entry)] for entry in peer["reads"]]
            rows += read or [[peer["name"], "nothing", "", ""]]
    lines.append(table(["at", "topics read", "at most", "not older than"], rows))
    saved = [(peer["name"], peer["saved"]) for peer in reply["peers"]] + [("all", reply["broadcasts_saved"])]
    kinds = ("unread", "thinned", "aged")
    rows = [
        [name, *(text for kind in kinds for text in (str(value[f"{kind}_messages"]), size(value[f"{kind}_bytes"])))]
        for name, value in saved
        if any(value[f"{kind}_messages"] for kind in kinds)
    ]
    if rows:
        lines += ["", table(["not sent to", "not read", "", "too many", "", "too old", ""], rows)]
    return "\n".join(lines)


def _bounds(entry: Json) -> tuple[str, str]:
    rate_hz, max_age_s = entry["rate_hz"], entry["max_age_s"]
    return "" if rate_hz is None else f"{rate_hz:g} Hz", "" if max_age_s is None else f"{max_age_s:g} s"


def _delivery(topic: Json) -> str:
    words = ["reliable" if topic["reliable"] else "best effort"]
    if topic["log"] is not None:
        readers = topic["log"]["readers"]
        words = ["log" + (f" for {', '.join(readers)}" if readers else "")]
    if topic["keep_last"] is not None:
        words.append(f"last {topic['keep_last']}")
    if topic["deadline_s"] is not None:
        words.append(f"within {topic['deadline_s']:g} s")
    if topic["rate_limit_bytes_per_s"] is not None:
        words.append(f"at most {size(topic['rate_limit_bytes_per_s'])}/s")
    if topic["compression"]:
        words.append("compressed")
    if topic["delta"]:
        words.append("differences")
    if topic["always"]:
        words.append("always")
    if topic["outbox"] != "none":
        words.append(f"outbox {topic['outbox']}" + (" on disk" if topic["outbox_on_disk"] else ""))
    if topic["destinations"]:
        words.append("to " + ", ".join(topic["destinations"]))
    return ", ".join(words)
