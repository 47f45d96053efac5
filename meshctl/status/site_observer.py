"""The nodes of sites, observed by the sites' workers: one uplink for each site, however many nodes it has.

At the site `answers_of` connects to the nodes and writes down what they said, unread (`meshctl status --answers`). The
operator's side parses it like an answer to itself, so drift, alarms and paths are found by the same code.
"""

from __future__ import annotations

import base64
import json
import threading
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from meshctl.device.observation import Observation
from meshctl.device.observe import RawObservation
from meshctl.device.traffic import TrafficMeter
from meshctl.errors import MeshctlError, NodeError, Unreachable
from meshctl.model import Fleet, Node, Site
from meshctl.nodes.connections import ConnectionPool
from meshctl.sites.connect import open_uplink
from meshctl.sites.dispatch import new_run_id
from meshctl.sites.protocol import WorkerError
from meshctl.sites.uplink import Uplink
from meshctl.status.values import NoAnswer

OPTIONS = ("--only", "--no-robots", "--answers")
# Each request costs every node of the site a login, which takes a second of a slow radio's processor.
PERIOD_S = 30.0
# What one node can say at most: a thousand originators take less than 1 MiB.
MAX_OUTPUT_BYTES = 16 << 20


def answers_json(
    answers: Mapping[str, RawObservation | NoAnswer], now_s: float, sent: Mapping[str, int]
) -> dict[str, object]:
    """Answers as JSON; `now_s` by the clock that the answers' times are of, `sent` the bytes to and from each node."""
    encoded = {name: _as_object(answer) for name, answer in answers.items()}
    return {"now_s": now_s, "answers": encoded, "sent_bytes": dict(sent)}


def _as_object(answer: RawObservation | NoAnswer) -> dict[str, object]:
    if isinstance(answer, NoAnswer):
        return {"reason": answer.reason, "code": answer.code, "hint": answer.hint}
    return {
        "nonce": answer.nonce,
        "output": base64.b64encode(zlib.compress(answer.output)).decode(),
        "asked_at_s": answer.asked_at_s,
        "answered_at_s": answer.answered_at_s,
    }


@dataclass(frozen=True, slots=True)
class SiteAnswers:
    """The answers that a worker passes on: one per node, and how many bytes went to and came from each device there."""

    answers: dict[str, Observation | NoAnswer]
    sent_bytes: dict[str, int]


def parse_answers(text: str, now_s: float) -> SiteAnswers:
    """The answers in what a worker printed, with times by our own clock, which shows `now_s`. Raises ValueError."""
    try:
        document = json.loads(text)
        ahead_s = float(document["now_s"]) - now_s
        answers = {str(name): _parsed(answer, ahead_s) for name, answer in document["answers"].items()}
        return SiteAnswers(answers, {str(name): int(count) for name, count in document["sent_bytes"].items()})
    except (AttributeError, KeyError, TypeError, zlib.error) as error:
        raise ValueError(f"not the answers of nodes: {type(error).__name__}: {error}") from error


def _parsed(answer: Mapping[str, Any], ahead_s: float) -> Observation | NoAnswer:
    if "output" not in answer:
        return NoAnswer(str(answer["reason"]), str(answer["code"]), str(answer["hint"]))
    unpack = zlib.decompressobj()
    output = unpack.decompress(base64.b64decode(str(answer["output"]), validate=True), MAX_OUTPUT_BYTES)
    if unpack.unconsumed_tail:
        raise ValueError(f"an answer of more than {MAX_OUTPUT_BYTES >> 20} MiB")
    asked_at_s, answered_at_s = (float(answer[name]) - ahead_s for name in ("asked_at_s", "answered_at_s"))
    return RawObservation(str(answer["nonce"]), output, asked_at_s, answered_at_s).interpret()


@dataclass(frozen=True, slots=True)
class _Answers:
    nodes: tuple[str, ...]
    asked_s: float
    answers: dict[str, Observation | NoAnswer]


@dataclass(slots=True)
class SiteObserver:
    """Asks the workers, and keeps their uplinks between snapshots. Sites may be asked at the same time, by one thread
    each. `part_of` makes a site's part of the inventory. Asked again within PERIOD_S, a site's last answers stand, with
    the times they are of."""

    fleet: Fleet
    access: ConnectionPool
    part_of: Callable[[Site], bytes]
    clock: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    open_uplink: Callable[[Fleet, Site, ConnectionPool], Uplink] = open_uplink
    _answers: dict[str, _Answers] = field(default_factory=dict, repr=False)
    _parts: dict[str, bytes] = field(default_factory=dict, repr=False)
    _uplinks: dict[str, Uplink] = field(default_factory=dict, repr=False)
    _meter: TrafficMeter = field(default_factory=TrafficMeter, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def site_of(self, node: Node) -> str:
        """The site whose worker can observe a node; empty if none can."""
        site = self.fleet.worker_site(node)
        return site.name if site is not None and site.worker_key else ""

    def observe(self, name: str, nodes: Sequence[str]) -> Mapping[str, Observation | NoAnswer]:
        """The answers of these nodes of a site to its worker. Raises NodeError: the worker could not be asked."""
        site, asked, now_s = self.fleet.sites[name], tuple(nodes), self.monotonic()
        kept = self._answers.get(name)
        if kept is not None and kept.nodes == asked and now_s - kept.asked_s < PERIOD_S:
            return kept.answers
        self._answers.pop(name, None)
        try:
            text = self._uplink(site).status(new_run_id(), self._part(site), asked, OPTIONS)
            found = parse_answers(text, self.clock())
            for device, count in found.sent_bytes.items():
                self._meter.add(device, count)
            self._answers[name] = _Answers(asked, now_s, found.answers)
            return found.answers
        except ValueError as error:
            raise _of_site(WorkerError(f"site {name}: its worker's answer is unusable: {error}"), name) from error
        except MeshctlError as error:
            self._drop(name)
            raise _of_site(error, name) from error

    def traffic(self) -> dict[str, int]:
        """Bytes that the workers exchanged with each device for us."""
        return self._meter.totals()

    def _part(self, site: Site) -> bytes:
        with self._lock:
            if site.name not in self._parts:
                self._parts[site.name] = self.part_of(site)
            return self._parts[site.name]

    def _uplink(self, site: Site) -> Uplink:
        with self._lock:
            kept = self._uplinks.get(site.name)
        if kept is None:
            kept = self.open_uplink(self.fleet, site, self.access)
            with self._lock:
                self._uplinks[site.name] = kept
        return kept

    def _drop(self, name: str) -> None:
        with self._lock:
            kept = self._uplinks.pop(name, None)
        if kept is not None:
            kept.close()

    def close(self) -> None:
        for name in tuple(self._uplinks):
            self._drop(name)


def _of_site(error: MeshctlError, site: str) -> NodeError:
    """An error of a site's worker as one of each of its nodes."""
    kind = Unreachable if isinstance(error, Unreachable) else NodeError
    found = kind(str(error), hint=error.hint)
    found.gateway_of = site
    return found
