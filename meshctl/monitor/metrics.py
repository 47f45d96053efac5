"""The newest frame as Prometheus metrics. docs/monitor.md lists them. Pure.

Names of radios' metrics are those of OpenWrt's `prometheus-node-exporter-lua` and of batman-adv's exporters, with the
label `node` added, so that dashboards for them fit; ours begin with `meshctl_`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from meshctl import __version__
from meshctl.monitor.alarm_log import LoggedAlarm
from meshctl.monitor.exposition import MetricFamily, exposition
from meshctl.monitor.frame import Frame
from meshctl.monitor.store import FrameStore

_COUNTER = re.compile(r"[a-z][a-z0-9_]*")
# Taken by the sizes of tables: a family may come once in a page.
_TABLE_COUNTS = frozenset(("originator_count", "tg_count"))
_OF_ONLINE_PEERS = frozenset(("round_trip_s", "loss", "capacity_bits_per_s"))
# The device of alarms that concern the whole fleet: an empty label would be none.
_FLEET = "fleet"
Document = Mapping[str, Any]


def render_metrics(frame: Frame | None, store: FrameStore | None = None, now_s: float | None = None) -> str:
    """The page for `/metrics` or a textfile. With `store`, alarms say whether they are acknowledged and, at `now_s` by
    the wall clock, silenced; default: at the frame's time."""
    alarms = None
    if store is not None and frame is not None:
        alarms = store.alarms(now_s=frame.time_s if now_s is None else now_s)
    return exposition(metric_families(frame, alarms))


def metric_families(frame: Frame | None, alarms: Iterable[LoggedAlarm] | None = None) -> Iterator[MetricFamily]:
    """All families, also those without a sample in this frame."""
    info = MetricFamily("meshctl_build_info", "gauge", "Always 1; the version of meshctl.")
    info.add(1, version=__version__)
    yield info
    document = {} if frame is None else frame.document
    status: Document = {} if frame is None else frame.status
    yield from _frame(document)
    nodes = [_Device(node) for node in status.get("nodes") or ()]
    yield from _nodes(nodes, status)
    yield from _air(nodes)
    yield from _links(document)
    yield from _batman(nodes)
    yield from _robots(status)
    yield from _beacons(nodes)
    yield _alarms(status, alarms)


class _Device:
    """A node's document, and whether it answers."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.name = document.get("name")

    def get(self, key: str) -> Any:
        return self.document.get(key)

    def items(self, key: str) -> Iterable[Document]:
        return self.document.get(key) or ()


def _frame(document: Document) -> Iterator[MetricFamily]:
    verdict, airtime = document.get("verdict") or {}, document.get("airtime") or {}
    fleet = document.get("fleet")
    rows: tuple[tuple[str, str, object], ...] = (
        ("meshctl_frame_timestamp_seconds", "When the fleet was last queried (Unix time).", document.get("time_s")),
        ("meshctl_frame_duration_seconds", "Duration of the latest query of the fleet.", document.get("took_s")),
        ("meshctl_go", "1 if preflight says go, 0 for no-go.", verdict.get("go")),
        (
            "meshctl_watch_bytes_per_second",
            "Bytes per second that monitoring sends and receives.",
            airtime.get("bytes_per_s"),
        ),
        (
            "meshctl_watch_airtime_ratio",
            "Share of the channel's airtime that monitoring takes, 0 to 1.",
            airtime.get("share"),
        ),
        ("meshctl_watch_interval_seconds", "Interval between queries of the fleet.", airtime.get("interval_s")),
    )
    for name, text, value in rows:
        family = MetricFamily(name, "gauge", text)
        family.add(value, fleet=fleet)
        yield family


def _nodes(nodes: Iterable[_Device], status: Document) -> Iterator[MetricFamily]:
    up = MetricFamily("meshctl_node_up", "gauge", "1 if the radio answers.")
    drift = MetricFamily("meshctl_node_drift", "gauge", "Files that differ from the inventory.")
    age = MetricFamily("meshctl_fact_age_seconds", "gauge", "Age of the facts about a device.")
    quality = MetricFamily("meshctl_path_quality_ratio", "gauge", "Quality of the whole path to the base, 0 to 1.")
    hops = MetricFamily("meshctl_path_hops", "gauge", "Hops to the base.")
    cut = MetricFamily("meshctl_node_cut_vertex", "gauge", "1 if other radios reach the base only through this one.")
    load = MetricFamily("node_load1", "gauge", "Load average over one minute.")
    boot = MetricFamily("node_boot_time_seconds", "gauge", "Boot time of the radio (Unix time).")
    info = MetricFamily("node_openwrt_info", "gauge", "Always 1; the OpenWrt release.")
    free = MetricFamily("meshctl_node_memory_free_ratio", "gauge", "Share of memory available, 0 to 1.")
    flash = MetricFamily("meshctl_node_flash_free_bytes", "gauge", "Free flash.")
    temperature = MetricFamily(
        "meshctl_node_temperature_celsius", "gauge", "Highest temperature that the board reports."
    )
    filtered = MetricFamily(
        "meshctl_node_lan_filter_dropped_packets_total",
        "counter",
        "Frames from its wired ports that the LAN filter dropped.",
    )
    for node in nodes:
        name = node.name
        filtered.add((node.get("lan_filter") or {}).get("dropped_packets"), node=name)
        up.add(node.get("answers"), node=name, role=node.get("role"), state=node.get("state"))
        age.add(node.get("age_s"), device=name, kind="radio")
        if (files := node.get("drift")) is not None:
            drift.add(len(files), node=name)
        quality.add(node.get("quality"), node=name)
        hops.add(node.get("hops"), node=name)
        cut.add(node.get("is_cut_vertex"), node=name)
        free.add(node.get("memory_free"), node=name)
        flash.add(node.get("flash_free_bytes"), node=name)
        temperature.add(node.get("temperature_c"), node=name)
        per_processor, processors = node.get("load"), node.get("processors")
        if per_processor is not None and processors is not None:
            load.add(round(per_processor * processors, 3), node=name)
        uptime_s, age_s, taken_s = node.get("uptime_s"), node.get("age_s"), status.get("taken_s")
        if uptime_s is not None and age_s is not None and taken_s is not None:
            boot.add(round(taken_s - age_s - uptime_s), node=name)
        if node.get("version"):
            info.add(1, node=name, release=node.get("version"), revision=node.get("revision"))
    for robot in status.get("robots") or ():
        age.add(robot.get("age_s"), device=robot.get("name"), kind="computer")
    yield from (up, drift, age, quality, hops, cut, free, flash, temperature, filtered, load, boot, info)


def _air(nodes: Iterable[_Device]) -> Iterator[MetricFamily]:
    noise = MetricFamily("wifi_network_noise_dbm", "gauge", "Noise on the channel.")
    stations = MetricFamily("wifi_stations", "gauge", "Neighbors that the radio hears.")
    busy = MetricFamily("meshctl_radio_busy_ratio", "gauge", "Share of time in which the channel was busy, 0 to 1.")
    queue = MetricFamily("meshctl_radio_queue_packets", "gauge", "Packets queued in the radio.")
    temperature = MetricFamily("meshctl_radio_temperature_celsius", "gauge", "Temperature of the radio.")
    station = {
        key: MetricFamily(f"wifi_station_{name}", kind, text)
        for key, name, kind, text in (
            ("signal_dbm", "signal_dbm", "gauge", "Signal of the neighbor."),
            ("inactive", "inactive_milliseconds", "gauge", "Time since the neighbor was heard."),
            (
                "expected_kbit_s",
                "expected_throughput_kilobits_per_second",
                "gauge",
                "Throughput that the rate control expects.",
            ),
            ("tx_bitrate_kbit_s", "transmit_kilobits_per_second", "gauge", "Bit rate to the neighbor."),
            ("rx_bitrate_kbit_s", "receive_kilobits_per_second", "gauge", "Bit rate from the neighbor."),
            ("tx_packets", "transmit_packets_total", "counter", "Frames sent to the neighbor."),
            ("tx_retries", "transmit_retries_total", "counter", "Frames retransmitted to the neighbor."),
            (
                "tx_failed",
                "transmit_failed_total",
                "counter",
                "Frames to the neighbor dropped after all retries.",
            ),
        )
    }
    for node in nodes:
        for radio in node.items("radios"):
            labels = {"node": node.name, "ifname": radio.get("ifname"), "mesh": radio.get("mesh")}
            noise.add(radio.get("noise_dbm"), **labels, channel=radio.get("channel"))
            busy.add(radio.get("busy_ratio"), **labels)
            queue.add(radio.get("queue_packets"), **labels)
            temperature.add(radio.get("temperature_c"), **labels)
        if node.get("neighbours") is not None:
            stations.add(len(node.get("neighbours")), node=node.name)
        for neighbor in node.items("neighbours"):
            age_s = neighbor.get("age_s")
            values = {**neighbor, "inactive": None if age_s is None else round(1000 * age_s)}
            for key, family in station.items():
                family.add(values.get(key), node=node.name, neighbor=neighbor.get("name"), mesh=neighbor.get("mesh"))
    yield from (noise, busy, queue, temperature, stations, *station.values())


def _links(document: Document) -> Iterator[MetricFamily]:
    quality = MetricFamily("meshctl_link_quality_ratio", "gauge", "Quality of a link, 0 to 1, as `to` reports it.")
    snr = MetricFamily("meshctl_link_snr_db", "gauge", "Signal above the noise of `from` at `to`.")
    for link in document.get("links") or ():
        labels = {"from_": link.get("from"), "to": link.get("to"), "mesh": link.get("mesh")}
        quality.add(link.get("quality"), **labels)
        snr.add(link.get("snr_db"), **labels)
    yield from (quality, snr)


def _batman(nodes: Iterable[_Device]) -> Iterator[MetricFamily]:
    """batman-adv's counters by the names of the kernel, as existing exporters have them: `batman_tx_bytes`; and the
    sizes of its tables by theirs."""
    originators = MetricFamily("batman_originator_count", "gauge", "Paths to originators: those in use, and others.")
    translations = MetricFamily("batman_tg_count", "gauge", "Entries of the global translation table by address type.")
    families: dict[str, MetricFamily] = {}
    for node in nodes:
        for batdev, sizes in (node.get("mesh_tables") or {}).items():
            labels = {"node": node.name, "batdev": batdev}
            originators.add(sizes.get("originators_other"), **labels, selected="false")
            originators.add(sizes.get("originators_selected"), **labels, selected="true")
            translations.add(sizes.get("tg_multicast"), **labels, type="multicast")
            translations.add(sizes.get("tg_unicast"), **labels, type="unicast")
        for batdev, counters in (node.get("mesh_statistics") or {}).items():
            for name, value in counters.items():
                # a name from a device becomes one of a metric
                if _COUNTER.fullmatch(name) and name not in _TABLE_COUNTS:
                    metric = f"batman_{name}"
                    text = f"Counter {name} of batman-adv."
                    families.setdefault(name, MetricFamily(metric, "counter", text)).add(
                        value, node=node.name, batdev=batdev
                    )
    yield from (originators, translations, *families.values())


def _robots(status: Document) -> Iterator[MetricFamily]:
    up = MetricFamily("meshctl_robot_up", "gauge", "1 if the robot's computer answers.")
    daemon = MetricFamily("meshctl_robot_daemon_up", "gauge", "1 if its udp_mesh daemon answers.")
    peer = {
        key: MetricFamily(f"meshctl_robot_peer_{name}", "gauge", text)
        for key, name, text in (
            ("online", "online", "1 if the daemon hears the peer."),
            ("round_trip_s", "round_trip_seconds", "Round trip to the peer's daemon."),
            ("loss", "loss_ratio", "Share of packets to the peer that are lost."),
            ("outbox_messages", "outbox_messages", "Messages stored for the offline peer."),
            ("outbox_bytes", "outbox_bytes", "Bytes stored for the offline peer."),
            ("capacity_bits_per_s", "capacity_bits_per_second", "Estimated capacity of the link for payload."),
        )
    }
    queue = {
        key: MetricFamily(f"meshctl_robot_queue_{name}", "gauge", text)
        for key, name, text in (
            ("messages", "messages", "Queued messages, by priority."),
            ("bytes", "bytes", "Queued bytes, by priority."),
            ("oldest_s", "oldest_seconds", "Age of the oldest queued message, by priority."),
        )
    }
    topic = MetricFamily("meshctl_robot_topic_age_seconds", "gauge", "Time since a topic's last message.")
    for robot in status.get("robots") or ():
        name = robot.get("name")
        up.add(robot.get("answers"), robot=name, state=robot.get("state"))
        daemon.add((robot.get("daemon") or {}).get("answers"), robot=name)
        for entry in robot.get("peers") or ():
            for key, family in peer.items():
                # the last values of an offline peer's link are not its current ones
                if entry.get("online") or key not in _OF_ONLINE_PEERS:
                    family.add(entry.get(key), robot=name, peer=entry.get("name"))
        for entry in robot.get("queues") or ():
            for key, family in queue.items():
                family.add(entry.get(key), robot=name, priority=entry.get("priority"))
        for entry in robot.get("topics") or ():
            topic.add(entry.get("sent_ago_s"), robot=name, topic=entry.get("name"), direction="sent")
            topic.add(entry.get("received_ago_s"), robot=name, topic=entry.get("name"), direction="received")
    yield from (up, daemon, *peer.values(), *queue.values(), topic)


def _beacons(nodes: Iterable[_Device]) -> Iterator[MetricFamily]:
    counts: dict[tuple[object, object], int] = {}
    for node in nodes:
        if node.get("role") == "beacon":
            key = (node.get("robot") or "", node.get("state"))
            counts[key] = counts.get(key, 0) + 1
    family = MetricFamily("meshctl_beacons", "gauge", "Beacons by the robot that carries them and by state.")
    for (robot, state), count in counts.items():
        family.add(count, robot=robot, state=state)
    yield family


def _alarms(status: Document, logged: Iterable[LoggedAlarm] | None) -> MetricFamily:
    """Open alarms, each 1."""
    family = MetricFamily("meshctl_alarm", "gauge", "1 for an open alarm.")
    if logged is not None:
        for alarm in logged:
            family.add(
                1,
                device=alarm.device or _FLEET,
                code=alarm.code,
                level=alarm.level,
                acknowledged=str(alarm.acknowledged is not None).lower(),
                silenced=str(alarm.silenced is not None).lower(),
            )
        return family
    # without a log, as of this frame
    devices = [(_FLEET, status)]
    for kind, prefix in (("nodes", ""), ("robots", "robot:")):
        devices += [(f"{prefix}{device.get('name')}", device) for device in status.get(kind) or ()]
    for name, device in devices:
        for open_alarm in device.get("alarms") or ():
            family.add(
                1,
                device=name,
                code=open_alarm.get("code"),
                level=open_alarm.get("level"),
                acknowledged="false",
                silenced="false",
            )
    return family
