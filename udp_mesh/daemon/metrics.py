"""Conditions -> Prometheus text format (exposition format 0.0.4). Pure."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping

from udp_mesh.core.conditions import Conditions
from udp_mesh.core.logs.conditions import LogConditions
from udp_mesh.core.subscriptions.conditions import SavedCounters
from udp_mesh.core.thin.conditions import ThinConditions, ThinLinkConditions
from udp_mesh.core.thin.link import ThinLinkCounters
from udp_mesh.core.versions.conditions import VersionConditions, VersionCounters
from udp_mesh.daemon.latencies import BOUNDS_S, Histogram
from udp_mesh.daemon.radio_paths import RadioNeighbor, RadioPath, RadioReport
from udp_mesh.daemon.status import TopicCount

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

Sample = tuple[Mapping[str, str], float]

_PEER_GAUGES = (
    ("peer_online", "1 if the peer is online, else 0.", lambda peer: float(peer.online)),
    (
        "peer_unanswered_seconds",
        "Time for which the peer has not answered anything sent to it.",
        lambda peer: peer.unanswered_for_s,
    ),
    ("peer_round_trip_seconds", "Smoothed round-trip time.", lambda peer: peer.round_trip_s),
    ("peer_least_round_trip_seconds", "Recent minimum round-trip time.", lambda peer: peer.least_round_trip_s),
    ("peer_loss_ratio", "Share of packets to the peer that are lost.", lambda peer: peer.loss),
    ("peer_sent_bits_per_second", "Wire bits sent to the peer.", lambda peer: peer.sent_bits_per_s),
    ("peer_delivered_bits_per_second", "Payload bits the peer acknowledged.", lambda peer: peer.delivered_bits_per_s),
    ("peer_received_bits_per_second", "Wire bits received from the peer.", lambda peer: peer.received_bits_per_s),
    ("peer_arrived_bits_per_second", "Wire bits the peer reports as received.", lambda peer: peer.arrived_bits_per_s),
    ("peer_sends_bits_per_second", "Wire bits the peer reports as sent.", lambda peer: peer.peer_sends_bits_per_s),
    ("peer_capacity_bits_per_second", "Estimated link capacity.", lambda peer: peer.capacity_bits_per_s),
    ("peer_window_packets", "Congestion window in packets.", lambda peer: peer.window_packets),
    ("peer_path_mtu_bytes", "Largest IP packet sent to the peer.", lambda peer: peer.path_mtu_bytes),
    ("peer_in_flight_packets", "Packets in flight.", lambda peer: float(peer.in_flight_packets)),
    ("peer_outbox_messages", "Messages stored for the offline peer.", lambda peer: float(peer.outbox_messages)),
    ("peer_outbox_bytes", "Bytes stored for the offline peer.", lambda peer: float(peer.outbox_bytes)),
)
# Base units and counters; the rates in bits per second above are kept for one release.
_PEER_COUNTERS = {
    "sent_bytes": "Wire bytes of messages sent to the peer.",
    "received_bytes": "Wire bytes of datagrams from the peer to this node alone.",
    "delivered_bytes": "Payload bytes the peer acknowledged.",
    "saved_messages": "Messages not sent because the peer's programs do not want them.",
    "saved_bytes": "Bytes of these messages.",
}
_BUILD_LABELS = ("version", "wire_version")
_QUEUE_GAUGES = (
    ("queue_messages", "Messages waiting.", lambda queue: float(queue.messages)),
    ("queue_bytes", "Bytes waiting.", lambda queue: float(queue.bytes)),
    ("queue_oldest_seconds", "Age of the oldest message waiting.", lambda queue: queue.oldest_s),
    ("queue_starved_seconds", "Time waited while more urgent messages were sent.", lambda queue: queue.starved_s),
    ("queue_held_seconds", "Time paused for other robots' urgent messages.", lambda queue: queue.held_s),
)


def render(
    conditions: Conditions,
    topics: Mapping[str, TopicCount],
    extra: Mapping[str, float],
    *,
    logs: Iterable[LogConditions] = (),
    versions: Iterable[VersionConditions] = (),
    thin: ThinConditions | None = None,
    about: Mapping[str, str],
    uptime_s: float,
    latencies: Mapping[int, Histogram] | None = None,
    broadcasts_saved: SavedCounters | None = None,
    radio: RadioReport | None = None,
) -> str:
    """The Prometheus page; `extra` are counters of the daemon itself, `about` the labels of the info metric,
    `latencies` those of deliveries by priority, `radio` the last report of a collector."""
    lines: list[str] = []
    _family(lines, "info", "gauge", "Always 1; the labels describe the node.", [(about, 1)])
    build = {name: about[name] for name in _BUILD_LABELS if name in about}
    _family(lines, "build_info", "gauge", "Always 1; the labels describe the program.", [(build, 1)])
    _family(lines, "uptime_seconds", "gauge", "Time since the daemon started.", [({}, round(uptime_s, 3))])
    for item in dataclasses.fields(conditions.counters):
        value = getattr(conditions.counters, item.name)
        _family(lines, f"{item.name}_total", "counter", item.name.replace("_", " ").capitalize() + ".", [({}, value)])
    for name in ("partial_bytes", "queued_bytes", "repair_bytes"):
        help_text = f"{name.replace('_', ' ').capitalize()} held."
        _family(lines, name, "gauge", help_text, [({}, getattr(conditions, name))])
    for name, help_text, value in (
        ("sent_bits_per_second", "Wire bits sent to all peers.", conditions.sent_bits_per_s),
        ("heard_bits_per_second", "Wire bits sent by all nodes heard here.", conditions.heard_bits_per_s),
    ):
        _family(lines, name, "gauge", help_text, [({}, value)])
    for name, help_text, read in _PEER_GAUGES:
        samples = [({"peer": peer.name}, value) for peer in conditions.peers if (value := read(peer)) is not None]
        _family(lines, name, "gauge", help_text, samples)
    for field_name, help_text in _PEER_COUNTERS.items():
        samples = [({"peer": peer.name}, float(getattr(peer, field_name))) for peer in conditions.peers]
        _family(lines, f"peer_{field_name}_total", "counter", help_text, samples)
    retransmitted = [({"peer": peer.name}, float(peer.retransmitted_packets)) for peer in conditions.peers]
    _family(lines, "peer_retransmitted_packets_total", "counter", "Retransmitted packets.", retransmitted)
    for name, help_text, read_queue in _QUEUE_GAUGES:
        samples = [
            ({"peer": peer.name, "priority": str(queue.priority)}, read_queue(queue))
            for peer in conditions.peers
            for queue in peer.queues
        ]
        _family(lines, name, "gauge", help_text, samples)
    _histogram(lines, "delivery_latency_seconds", "Time from sending a message to its acknowledgment.", latencies or {})
    for field_name in ("sent_messages", "sent_bytes", "received_messages", "received_bytes"):
        samples = [({"topic": topic}, float(getattr(count, field_name))) for topic, count in sorted(topics.items())]
        help_text = f"{field_name.replace('_', ' ').capitalize()} of the topic."
        _family(lines, f"topic_{field_name}_total", "counter", help_text, samples)
    lines += _log_lines(tuple(logs))
    lines += _version_lines(tuple(versions))
    if broadcasts_saved is not None:
        for name, total in (("messages", broadcasts_saved.messages), ("bytes", broadcasts_saved.bytes)):
            help_text = f"{name.capitalize()} to all, not sent because no peer's programs want them."
            _family(lines, f"broadcasts_saved_{name}_total", "counter", help_text, [({}, total)])
    lines += [] if thin is None else _thin_lines(thin)
    lines += [] if radio is None else _radio_lines(radio, [peer.name for peer in conditions.peers], conditions.now)
    for name, number in extra.items():
        _family(lines, f"{name}_total", "counter", name.replace("_", " ").capitalize() + ".", [({}, number)])
    return "\n".join(lines) + "\n"


_LOG_GAUGES: tuple[tuple[str, str, Callable[[LogConditions], int]], ...] = (
    ("log_held_items", "Items of the log on disk here.", lambda log: log.held_items),
    ("log_held_bytes", "Bytes of the log on disk here.", lambda log: log.held_bytes),
    ("log_newest_number", "Highest number of the log that arrived here.", lambda log: log.newest),
    ("log_known_items", "Items that exist, as far as this node has heard.", lambda log: log.known_items),
    ("log_waiting_items", "Items that no local program has taken.", lambda log: log.waiting_items),
)


def _log_lines(logs: tuple[LogConditions, ...]) -> list[str]:
    lines: list[str] = []
    for name, help_text, read in _LOG_GAUGES:
        samples = [({"topic": log.topic, "source": log.source, "log": log.log_id.hex()[:8]}, read(log)) for log in logs]
        _family(lines, name, "gauge", help_text, samples)
    missing = [
        ({"topic": log.topic, "source": log.source, "log": log.log_id.hex()[:8], "reader": reader}, float(count))
        for log in logs
        for reader, count in log.missing_readers
    ]
    _family(lines, "log_missing_items", "gauge", "Items that a reader is not known to have.", missing)
    return lines


_RADIO_PATH_GAUGES: tuple[tuple[str, str, Callable[[RadioPath], float | None]], ...] = (
    ("signal_dbm", "Signal of the next hop, as the robot's radio hears it.", lambda neighbor: neighbor.signal_dbm),
    ("noise_dbm", "Noise at the robot's radio.", lambda neighbor: neighbor.noise_dbm),
    ("margin_db", "What the next hop's signal is above what the load needs.", lambda neighbor: neighbor.margin_db),
    ("bottleneck_bits_per_second", "Least rate known of the path.", lambda neighbor: neighbor.bottleneck_bits_per_s),
    ("quality_ratio", "Share of the routing protocol's packets that arrive.", lambda neighbor: neighbor.quality),
    ("trend_db_per_second", "Change of the signal; negative: worsening.", lambda neighbor: neighbor.change_db_per_s),
)
_RADIO_NEIGHBOR_GAUGES: tuple[tuple[str, str, Callable[[RadioNeighbor], float | None]], ...] = (
    ("signal_dbm", "Signal of a neighbor, as the radio hears it.", lambda neighbor: neighbor.signal_dbm),
    ("margin_db", "What the signal of a neighbor is above what the load needs.", lambda neighbor: neighbor.margin_db),
)


def _radio_lines(radio: RadioReport, peers: Iterable[str], now: float) -> list[str]:
    """The age and whether there is a problem remain when a collector is silent, for an alert; its values do not."""
    lines: list[str] = []
    age_s = round(max(0.0, now - radio.reported_at), 3)
    _family(lines, "radio_report_age_seconds", "gauge", "Time since the collector's last report.", [({}, age_s)])
    help_text = "1 if a radio gives the collector no new values, else 0."
    _family(lines, "radio_problem", "gauge", help_text, [({}, float(bool(radio.problem)))])
    paths = [path for name in peers if (path := radio.recent_path(name, now)) is not None]
    about = [({"peer": path.peer, "radio": path.radio, "next_hop": path.next_hop}, 1.0) for path in paths]
    _family(lines, "radio_path_info", "gauge", "Always 1; the labels describe the radio path to the peer.", about)
    for name, help_text, read in _RADIO_PATH_GAUGES:
        samples = [({"peer": path.peer}, value) for path in paths if (value := read(path)) is not None]
        _family(lines, f"radio_path_{name}", "gauge", help_text, samples)
    neighbors = {(neighbor.name, neighbor.radio): neighbor for neighbor in radio.recent_neighbors(now)}
    for name, help_text, value_of in _RADIO_NEIGHBOR_GAUGES:
        samples = [
            ({"neighbor": neighbor.name, "radio": neighbor.radio}, value)
            for neighbor in neighbors.values()
            if (value := value_of(neighbor)) is not None
        ]
        _family(lines, f"radio_neighbor_{name}", "gauge", help_text, samples)
    return lines


_THIN_GAUGES: tuple[tuple[str, str, Callable[[ThinLinkConditions], float]], ...] = (
    ("thin_up", "1 if the thin link's port is open, else 0.", lambda link: float(link.up)),
    ("thin_budget_seconds", "Airtime that the node may use in the window.", lambda link: link.budget_s),
    ("thin_burst_seconds", "Airtime that may be used at once, if the budget is full.", lambda link: link.burst_s),
    ("thin_available_seconds", "Airtime that may be used now.", lambda link: link.available_s),
    ("thin_queued_messages", "Messages waiting for the thin link.", lambda link: float(link.queued_messages)),
    ("thin_rejecting", "1 while the link accepts nothing.", lambda link: float(link.rejecting_s is not None)),
)


def _thin_lines(thin: ThinConditions) -> list[str]:
    lines: list[str] = []
    for name, help_text, read in _THIN_GAUGES:
        _family(lines, name, "gauge", help_text, [({"link": link.name}, read(link)) for link in thin.links])
    airtimes = [({"link": link.name}, link.airtime_s) for link in thin.links]
    _family(lines, "thin_airtime_seconds_total", "counter", "Airtime used since the start.", airtimes)
    for item in dataclasses.fields(ThinLinkCounters):
        counts = [({"link": link.name}, float(getattr(link.counters, item.name))) for link in thin.links]
        help_text = f"{item.name.replace('_', ' ').capitalize()}, of thin links."
        _family(lines, f"thin_{item.name}_total", "counter", help_text, counts)
    present = [({"peer": peer.name}, float(peer.present)) for peer in thin.peers]
    _family(lines, "thin_peer_present", "gauge", "1 if the peer is heard on a thin link, and hears us.", present)
    only = [({"peer": peer.name}, float(peer.present and peer.only_thin)) for peer in thin.peers]
    _family(lines, "thin_peer_only", "gauge", "1 if only thin links reach the peer.", only)
    copies: list[Sample] = [({}, float(thin.copies_dropped))]
    _family(lines, "thin_copies_dropped_total", "counter", "Copies of messages that had arrived already.", copies)
    return lines


def _version_lines(versions: tuple[VersionConditions, ...]) -> list[str]:
    lines: list[str] = []
    for item in dataclasses.fields(VersionCounters):
        samples = [({"topic": entry.topic}, float(getattr(entry.counters, item.name))) for entry in versions]
        help_text = f"{item.name.replace('_', ' ').capitalize()}, of topics with differences."
        _family(lines, f"version_{item.name}_total", "counter", help_text, samples)
    return lines


def _histogram(lines: list[str], name: str, help_text: str, by_priority: Mapping[int, Histogram]) -> None:
    """A histogram with the label `priority`: cumulative buckets, sum and count of each."""
    if not by_priority:
        return
    lines += [f"# HELP udp_mesh_{name} {help_text}", f"# TYPE udp_mesh_{name} histogram"]
    for priority, histogram in sorted(by_priority.items()):
        total = 0
        for bound, count in zip((*map(str, BOUNDS_S), "+Inf"), histogram.counts, strict=True):
            total += count
            lines.append(f'udp_mesh_{name}_bucket{{priority="{priority}",le="{bound}"}} {total}')
        lines.append(f'udp_mesh_{name}_sum{{priority="{priority}"}} {_number(histogram.sum_s)}')
        lines.append(f'udp_mesh_{name}_count{{priority="{priority}"}} {total}')


def _family(lines: list[str], name: str, kind: str, help_text: str, samples: Iterable[Sample]) -> None:
    rows = list(samples)
    if not rows:
        return
    lines += [f"# HELP udp_mesh_{name} {help_text}", f"# TYPE udp_mesh_{name} {kind}"]
    for labels, value in rows:
        inner = ",".join(f'{label}="{_escape(text)}"' for label, text in labels.items())
        lines.append(f"udp_mesh_{name}{{{inner}}} {_number(value)}" if inner else f"udp_mesh_{name} {_number(value)}")


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else repr(value)


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')
