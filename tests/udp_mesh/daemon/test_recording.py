"""A recording is written by a thread: complete when closed, with its gaps recorded, without making a caller wait."""

import json
import random
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.udp_mesh.links.sockets import WAIT_S
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessageId,
    MessagePeerLost,
    PeerOffline,
)
from udp_mesh.core.logs.conditions import LogConditions
from udp_mesh.core.settings import Settings
from udp_mesh.core.versions.conditions import VersionConditions, VersionCounters
from udp_mesh.daemon import recording
from udp_mesh.daemon.recording import Recorder
from udp_mesh.report.aggregate import read
from udp_mesh.report.recording import LogProgress


def recorder(path: Path, limit_bytes: int = 1 << 20) -> Recorder:
    return Recorder(path, node="scout", boot_id=bytes(8), wall_s=1e9, now=0.0, limit_bytes=limit_bytes, payloads=False)


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_bytes().splitlines()]


def test_everything_recorded_is_in_the_file_once_it_is_closed(tmp_path: Path) -> None:
    made = recorder(tmp_path / "run.jsonl")
    for number in range(3000):
        made.event(number / 100, PeerOffline("base", left=False))
    made.close().result(WAIT_S)
    found = lines(made.path)
    assert len(found) == made.lines == 3001
    assert [line["t"] for line in found[1:]] == [number / 100 for number in range(3000)]
    assert made.path.stat().st_size == made.bytes
    assert not made.open
    made.event(31.0, PeerOffline("base", left=False))
    made.close().result(WAIT_S)
    assert made.lines == 3001


def test_outcomes_of_internal_messages_are_not_recorded(tmp_path: Path) -> None:
    made = recorder(tmp_path / "run.jsonl")
    for topic in ("~mesh/ping", "status"):
        made.event(1.0, MessageDelivered(MessageId(1), "base", topic, 0.02))
        made.event(1.0, MessageExpired(MessageId(1), "base", topic, ExpiryReason.DEADLINE))
        made.event(1.0, MessagePeerLost(MessageId(1), "base", topic))
    made.close().result(WAIT_S)
    assert [line["topic"] for line in lines(made.path)[1:]] == ["status"] * 3


def test_a_recording_ends_at_its_limit(tmp_path: Path) -> None:
    made = recorder(tmp_path / "run.jsonl", limit_bytes=2000)
    for number in range(100):
        made.event(float(number), PeerOffline("base", left=False))
    assert not made.open
    made.close().result(WAIT_S)
    assert 1900 < made.path.stat().st_size <= 2000


def test_lines_for_a_hung_disk_are_dropped_and_the_gap_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "MAX_BACKLOG_BYTES", 3 * recording.BATCH_BYTES)
    made = recorder(tmp_path / "run.jsonl", limit_bytes=1 << 24)
    go_on = threading.Event()
    made._disk.submit(go_on.wait, WAIT_S)
    for number in range(10_000):
        made.event(float(number), PeerOffline("base", left=False))
    go_on.set()
    made._disk.submit(lambda: None).result(WAIT_S)
    made.event(10_000.0, PeerOffline("base", left=False))
    made.close().result(WAIT_S)
    found = lines(made.path)
    (gap,) = [line for line in found[1:] if line["kind"] == "gap"]
    assert found[-2] == gap
    assert gap["lines"] + len(found) - 3 == 10_000
    assert made.path.stat().st_size == made.bytes


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.jsonl").write_text("of yesterday")
    with pytest.raises(FileExistsError):
        recorder(tmp_path / "run.jsonl")
    assert (tmp_path / "run.jsonl").read_text() == "of yesterday"


def test_counters_of_differences_and_shared_logs_reach_the_report(tmp_path: Path) -> None:
    made = recorder(tmp_path / "run.jsonl")
    endpoint = Endpoint(Settings("scout", unkeyed=True), boot_id=bytes(16), rng=random.Random(1), now=0.0)
    log = LogConditions("artifact", "scout", bytes(32), 2, 900, 3, 3, 5, 0, (("base", 1),), ())
    for saved, logs in ((0, ()), (400, (log,))):
        counters = VersionCounters(whole_sent=1, payload_bytes_sent=1000 + saved, body_bytes_sent=1000)
        made.conditions(endpoint.conditions(float(saved)), [VersionConditions("map", counters)], logs)
    made.conditions(endpoint.conditions(401.0))
    made.close().result(WAIT_S)
    found = read(made.path)
    assert found.problems == []
    ((first, last),) = found.versions.values()
    assert last.since(first).payload_bytes == 400
    assert found.logs == {("artifact", "scout"): LogProgress(3, 5, 900)}
    assert "versions" not in lines(made.path)[-1]
