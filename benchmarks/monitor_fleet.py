"""A fleet in a tunnel as frames of `meshctl monitor`, for pictures and for measuring the page: no radio is behind it.

Robots leave the base one after the other and drop beacons; signals fall with distance and walls; one beacon loses its
power for a while, a robot drives out of reach and returns, one radio hears worse than it sends. The same arguments give
the same frames.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from meshctl.monitor.frame import Frame, links_of
from meshctl.topology.graph import Graph, Link, graph_of

REACH_M = 95.0
LEG_M = 60.0
PRIORITIES = (0, 1, 2, 3, 6, 9)
TOPICS = {
    "emergency_stop": (0, "emergency_stop"),
    "commands": (1, "command"),
    "artifacts": (2, "artifact"),
    "telemetry": (3, "telemetry"),
    "map_diffs": (6, "map"),
    "fpv": (9, "video"),
}
TOPIC_CLASSES = {name: topic_class for name, (_, topic_class) in TOPICS.items()}


@dataclass(slots=True)
class _Radio:
    name: str
    role: str
    robot: str | None
    x_m: float
    y_m: float
    state: str = "deployed"
    is_on: bool = True
    last_answer_s: float | None = None


@dataclass(slots=True)
class TunnelRun:
    """`frames` yields one frame per `interval_s`, `count` in all, the first at `start_s`."""

    robots: int
    radios: int
    start_s: float
    interval_s: float = 5.0
    seed: int = 1
    with_positions: bool = True
    _radios: dict[str, _Radio] = field(default_factory=dict)

    def frames(self, count: int) -> Iterator[Frame]:
        self._radios = {"base": _Radio("base", "base", "base-station", 0.0, 0.0)}
        names = [f"{kind}{number}" for number in range(1, 9) for kind in ("spot", "husky", "uav")][: self.robots]
        for name in names:
            self._radios[name] = _Radio(name, "robot", name, 0.0, 0.0)
        beacons = max(0, self.radios - 1 - len(names))
        for index in range(beacons):
            owner = names[index % len(names)] if names else None
            self._radios[f"b{index + 1:02}"] = _Radio(f"b{index + 1:02}", "beacon", owner, 0.0, 0.0, state="carried")
        for index in range(count):
            progress = index / max(1, count - 1)
            self._move(names, beacons, progress, self.start_s + index * self.interval_s)
            yield self._frame(names, progress, self.start_s + index * self.interval_s)

    def _move(self, names: list[str], beacons: int, progress: float, now_s: float) -> None:
        """Beacons lie along the branch of their robot, as far as it has come; the robot is ahead of its newest one."""
        per_robot = math.ceil(beacons / max(1, len(names)))
        for rank, name in enumerate(names):
            depth_m = max(0.0, min(1.0, 1.35 * progress + 0.1 - 0.02 * (rank % 4))) * (per_robot + 0.8) * LEG_M
            robot = self._radios[name]
            robot.x_m, robot.y_m = _place(rank, len(names), depth_m)
            # one drives out of reach and returns
            if rank == 1 and 0.55 < progress < 0.7:
                robot.x_m, robot.y_m = robot.x_m * 1.5, robot.y_m * 1.5
        for index in range(beacons):
            beacon = self._radios[f"b{index + 1:02}"]
            rank, number = index % max(1, len(names)), index // max(1, len(names))
            place_m = (number + 0.85) * LEG_M
            robot_m = max(0.0, min(1.0, 1.35 * progress + 0.1 - 0.02 * (rank % 4))) * (per_robot + 0.8) * LEG_M
            if robot_m >= place_m:
                beacon.state = "deployed"
                beacon.x_m, beacon.y_m = _place(rank, len(names), place_m)
        if beacons > 2:
            self._radios["b02"].is_on = not 0.45 < progress < 0.62

    def _quality(self, a: _Radio, b: _Radio, now_s: float) -> tuple[float, float] | None:
        """SNR in dB in both directions; None out of reach."""
        distance_m = math.hypot(a.x_m - b.x_m, a.y_m - b.y_m)
        if distance_m > REACH_M * 1.35:
            return None
        shadow = random.Random(f"{self.seed} {a.name} {b.name}").gauss(0.0, 4.0)
        fading = random.Random(f"{self.seed} {a.name} {b.name} {round(now_s)}").gauss(0.0, 1.2)
        snr_db = 78.0 - 32.0 * math.log10(max(4.0, distance_m)) + shadow + fading
        # one radio's antenna is damaged: it hears worse than it is heard
        deaf = {"b05": 9.0}
        return snr_db - deaf.get(a.name, 0.0), snr_db - deaf.get(b.name, 0.0)

    def _frame(self, names: list[str], progress: float, now_s: float) -> Frame:
        on = [radio for radio in self._radios.values() if radio.is_on and radio.state == "deployed"]
        heard: dict[str, list[dict[str, Any]]] = {radio.name: [] for radio in on}
        links = []
        for index, a in enumerate(on):
            for b in on[index + 1 :]:
                found = self._quality(a, b, now_s)
                if found is None:
                    continue
                for hearer, sender, snr_db in ((a, b, found[0]), (b, a, found[1])):
                    if snr_db > 3.0:
                        heard[hearer.name].append(_neighbor(sender.name, snr_db))
                if min(found) > 3.0:
                    links.append(Link(a.name, b.name, _share(min(found))))
        graph = graph_of([radio.name for radio in on], links)
        # an answer needs a path to the base
        reachable = graph.reachable("base")
        for name in reachable:
            self._radios[name].last_answer_s = now_s
        status = self._status(names, graph, heard, reachable, progress, now_s)
        document = {
            "schema": 1,
            "time_s": now_s,
            "took_s": 0.6,
            "fleet": "tunnel",
            "verdict": _verdict(status),
            "status": status,
            "links": links_of(status),
            "radios": {radio.name: [self._radio(radio, now_s)] for radio in on if radio.name in reachable},
            "positions": self._positions(on, reachable) if self.with_positions else {},
            "airtime": {"bytes_per_s": 3100.0, "share": 0.006, "limit_share": 0.03, "interval_s": self.interval_s},
        }
        return Frame.of(document)

    def _radio(self, radio: _Radio, now_s: float) -> dict[str, Any]:
        wave = random.Random(f"{radio.name} {round(now_s)}").random()
        busy = 0.18 + 0.25 * wave + (0.2 if radio.role == "base" else 0.0)
        # not every board has a thermometer
        temperature_c = None if radio.role == "beacon" else 41.0
        return {
            "ifname": "mesh0",
            "channel": 149,
            "noise_dbm": -95,
            "busy_ratio": round(busy, 3),
            "queue_packets": round(40 * wave**4),
            "temperature_c": temperature_c,
        }

    def _positions(self, on: list[_Radio], reachable: frozenset[str]) -> dict[str, Any]:
        return {
            radio.robot or radio.name if radio.role == "robot" else radio.name: {
                "x_m": round(radio.x_m, 2),
                "y_m": round(radio.y_m, 2),
                "z_m": None,
                "age_s": 0.4,
                "source": "daemon",
            }
            for radio in on
            if radio.name in reachable or radio.role != "robot"
        }

    def _status(
        self,
        names: list[str],
        graph: Graph,
        heard: Mapping[str, list[dict[str, Any]]],
        reachable: frozenset[str],
        progress: float,
        now_s: float,
    ) -> dict[str, Any]:
        paths = graph.paths("base")
        cut_off = graph.cut_off_by("base")
        nodes = [
            self._node(radio, paths, cut_off, heard, is_answering=radio.name in reachable, now_s=now_s)
            for radio in self._radios.values()
        ]
        robots = [self._robot(name, names, reachable, progress, now_s) for name in ("base", *names)]
        alarms = [alarm for device in (*nodes, *robots) for alarm in device["alarms"]]
        return {
            "version": 1,
            "fleet": "tunnel",
            "taken_s": now_s,
            "took_s": 0.6,
            "entry": "base",
            "exit_code": 0,
            "totals": {
                kind: {
                    health: sum(device["health"] == health for device in listed)
                    for health in ("ok", "degraded", "unreachable", "off")
                }
                for kind, listed in (("nodes", nodes), ("robots", robots))
            }
            | {
                "alarms": {
                    level: sum(alarm["level"] == level for alarm in alarms) for level in ("note", "warning", "error")
                }
            },
            "alarms": [],
            "strangers": [],
            "nodes": nodes,
            "robots": robots,
        }

    def _node(
        self,
        radio: _Radio,
        paths: Mapping[str, Any],
        cut_off: Mapping[str, tuple[str, ...]],
        heard: Mapping[str, list[dict[str, Any]]],
        *,
        is_answering: bool,
        now_s: float,
    ) -> dict[str, Any]:
        path = paths.get(radio.name)
        alarms = []
        if radio.name in cut_off:
            count = len(cut_off[radio.name])
            alarms.append(
                _alarm("note", "cut-vertex", f"without it {count} radio{'' if count == 1 else 's'} would be cut off")
            )
        if path is not None and path.quality < 0.3:
            alarms.append(_alarm("warning", "weak", f"its path to the base has a quality of {path.quality:.0%}"))
        if radio.state == "deployed" and not is_answering:
            alarms = [_alarm("error", "unreachable", "no answer at 10.42.0.1", "check its battery")]
        health = "off" if radio.state == "carried" else "unreachable" if not is_answering else "ok"
        if health == "ok" and any(alarm["level"] != "note" for alarm in alarms):
            health = "degraded"
        last_s = radio.last_answer_s
        return {
            "name": radio.name,
            "role": radio.role,
            "state": radio.state,
            "robot": radio.robot,
            "address": f"10.42.0.{list(self._radios).index(radio.name) + 1}",
            "health": health,
            "answers": is_answering,
            "silent_because": None if is_answering else "connection timed out",
            "age_s": None if last_s is None else round(now_s - last_s + 0.4, 3),
            "alarms": alarms,
            "version": "23.05.5" if is_answering else None,
            "revision": None,
            "drift": [] if is_answering else None,
            "uptime_s": 1800.0 + now_s - self.start_s if is_answering else None,
            "load": 0.21 if is_answering else None,
            "memory_free": 0.6 if is_answering else None,
            "flash_free_bytes": 8_200_192 if is_answering else None,
            "clock_offset_s": 0.1 if is_answering else None,
            "channels": [149] if is_answering else None,
            "tx_power_dbm": 24.0 if is_answering else None,
            "bridge_ports": ["bat0", "eth0"] if is_answering else None,
            "neighbours": heard.get(radio.name, []) if is_answering else None,
            "hops": None if path is None or not is_answering else path.hops,
            "quality": None if path is None or not is_answering else round(path.quality, 3),
            "via": None if path is None or not is_answering or radio.name == "base" else path.via,
            "is_cut_vertex": radio.name in cut_off if is_answering else None,
            "heard_by": [],
            "last_known": None,
        }

    def _robot(
        self, name: str, names: list[str], reachable: frozenset[str], progress: float, now_s: float
    ) -> dict[str, Any]:
        radio = self._radios[name]
        draw = random.Random(f"{name} {round(now_s)}")
        is_base, answers = name == "base", name in reachable
        robot = "base-station" if is_base else name
        base = {
            "name": robot,
            "is_base": is_base,
            "state": "deployed",
            "radios": [name],
            "address": "10.42.0.2",
            "health": "ok" if answers else "unreachable",
            "answers": answers,
            "silent_because": None if answers else "connection timed out",
            "age_s": 0.5 if answers else round(now_s - (radio.last_answer_s or now_s) + 0.5, 3),
            "alarms": [] if answers else [_alarm("error", "unreachable", "no answer", "wait until it is in reach")],
            "heard_by": [],
            "last_known": None,
        }
        if not answers:
            return {**base, "computer": None, "daemon": None, "bridge": None, "peers": None, "queues": None,
                    "topics": None}  # fmt: skip
        hops = 1 + names.index(name) % 4 if not is_base else 0
        peers = [
            {
                "name": "base-station" if other == "base" else other,
                "online": other in reachable,
                "heard_ago_s": 0.4,
                "round_trip_s": round(0.006 * (hops + 1) * (0.8 + draw.random()), 6),
                "loss": round(0.01 * hops * draw.random(), 3),
                "outbox_messages": 0 if other in reachable else 12,
                "capacity_bits_per_s": round(9e6 / (hops + 1) * (0.8 + 0.4 * draw.random())),
            }
            for other in ("base", *names)
            if other != name
        ]
        waiting = {
            0: 0,
            1: 0,
            2: round(draw.random()),
            3: round(3 * draw.random()),
            6: round(4 + 50 * progress * draw.random() ** 2),
            9: 0,
        }
        return {
            **base,
            "computer": {"uptime_s": 4000.0, "load": 1.2, "processors": 8, "memory_kib": 16_000_000,
                         "memory_free_kib": 9_000_000, "disk_kib": None, "disk_free_kib": None, "clock_ahead_s": 0.01},
            "daemon": {"answers": True, "service": "active", "enabled": "enabled", "restarts": 0, "version": "0.1.0",
                       "release": "r1", "previous": None, "is_proven": True, "drift": [], "uptime_s": 3900.0,
                       "keys": ["1"], "unkeyed": False},
            "bridge": None,
            "peers": peers,
            "queues": [
                {"priority": p, "messages": 0 if is_base else waiting[p], "bytes": waiting[p] * 1200,
                 "oldest_s": round(0.08 * waiting[p], 3)}
                for p in PRIORITIES
            ],
            "topics": [
                {"name": topic, "priority": priority,
                 "sent_ago_s": None if topic == "emergency_stop" else round(draw.random() * longest_s, 3),
                 "received_ago_s": round(draw.random() * longest_s, 3),
                 "limit_s": 10.0 if topic == "telemetry" else None, "trouble": None}
                for topic, (priority, _) in TOPICS.items()
                for longest_s in (40.0 if topic == "artifacts" else 0.8,)
            ],
        }  # fmt: skip


def _place(rank: int, count: int, depth_m: float) -> tuple[float, float]:
    """A place in the tunnel: branches that leave the base in a fan, with bends."""
    if count > 8:
        # a large fleet: rows of a mine, one above the other
        return depth_m * 1.2, (rank - (count - 1) / 2) * 46.0 * min(1.0, depth_m / 120.0) + 9.0 * math.sin(
            depth_m / 70.0
        )
    angle = (rank - (count - 1) / 2) * min(0.9, 2.6 / max(1, count))
    bend = 0.28 * math.sin(depth_m / 95.0 + 2.0 * rank)
    return depth_m * math.cos(angle + bend), depth_m * math.sin(angle + bend)


def _neighbor(name: str, snr_db: float) -> dict[str, Any]:
    snr = round(snr_db)
    return {
        "name": name,
        "age_s": 0.4,
        "quality": round(_share(snr_db), 3),
        "signal_dbm": snr - 95,
        "noise_dbm": -95,
        "snr_db": snr,
        "rx_mcs": f"MCS {max(0, min(7, (snr - 5) // 4))}",
        "rx_bitrate_kbit_s": 1000 * max(6, min(65, 2 * snr)),
    }


def _share(snr_db: float) -> float:
    """Delivery probability at this SNR."""
    return 1.0 / (1.0 + math.exp(-(snr_db - 9.0) / 2.5))


def _alarm(level: str, code: str, text: str, hint: str = "") -> dict[str, str]:
    return {"level": level, "code": code, "text": text, "hint": hint}


def _verdict(status: Mapping[str, Any]) -> dict[str, Any]:
    lost = [node["name"] for node in status["nodes"] if node["health"] == "unreachable"]
    return {
        "go": not lost,
        "text": "NO-GO" if lost else "GO",
        "reasons": [f"radios: no answer from {', '.join(lost)}"] if lost else [],
    }
