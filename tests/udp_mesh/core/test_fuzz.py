"""Any bytes at every decoder of the network: frames within their caps, or a counted drop, never an exception.

`make test` runs 4,000 inputs per surface. The proof runs `UDP_MESH_FUZZ_INPUTS` inputs over all surfaces, 10^8 by
default. `benchmarks/results/fuzz.jsonl` has the totals of the last run of each surface.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.udp_mesh.core import fuzzing
from tests.udp_mesh.core.fuzzing import (
    SURFACES,
    Chunk,
    Fuzzer,
    hostile_frames,
    legacy,
    log_messages,
    mutated_datagrams,
    random_bytes,
    relay_frames,
    serial_lines,
    subscriptions,
    versions,
)
from udp_mesh.core.events import MessageReceived

INPUTS = int(os.environ.get("UDP_MESH_FUZZ_INPUTS", "100000000"))


@pytest.mark.parametrize("surface", SURFACES)
def test_arbitrary_bytes_are_accepted_or_counted_as_dropped(surface: str) -> None:
    Chunk(surface, tuple(SURFACES).index(surface), 4_000).run()


def test_a_pair_still_communicates_after_fuzzed_input() -> None:
    fuzzer = Fuzzer(seed=77)
    for surface in (random_bytes, mutated_datagrams, legacy):
        fuzzer.run(surface, 1000)
    both = fuzzer.pair
    both.roundtrip(times=30)
    both.events(both.b)
    both.a.send("any", b"still here", destination="b", now=both.now)
    both.roundtrip(times=100)
    assert any(isinstance(event, MessageReceived) and event.payload == b"still here" for event in both.events(both.b))


def test_running_nodes_still_work_after_fuzzed_input() -> None:
    fuzzer = Fuzzer(seed=78)
    for surface in (relay_frames, log_messages, subscriptions, versions, hostile_frames):
        fuzzer.run(surface, 1000)
    fuzzer.check_bounds()
    assert fuzzer.relay.works()
    assert fuzzer.logs.works()
    assert fuzzer.messages.works()
    assert fuzzer.hostile.works()


def test_fuzzed_input_gets_past_what_drops_it_early() -> None:
    """Else a surface would prove nothing: messages without their sender's clock, for one, are dropped unread."""
    fuzzer = Fuzzer(seed=80)
    for surface in (subscriptions, versions, serial_lines):
        fuzzer.run(surface, 1000)
    node = fuzzer.messages.world.nodes["a"]
    (peer,) = node.selective.conditions().peers
    assert peer.subscriptions
    assert node.conditions(fuzzer.messages.world.now).counters.dropped_malformed > 0
    grid = node._state.peer_table.version_counters.of("grid")
    assert min(grid.whole_received, grid.differences_received, grid.bases_missing, grid.damaged) > 0
    counters = fuzzer.thin.conditions("b").links[0].counters
    assert min(counters.frames_received, counters.frames_malformed) > 0
    assert all(decoder.damaged > 0 for decoder in fuzzer.line._decoders)


def test_frames_still_arrive_over_a_serial_line_after_fuzzed_input() -> None:
    fuzzer = Fuzzer(seed=79)
    fuzzer.run(serial_lines, 3000)
    for framing in range(3):
        fuzzer.line.feed(framing, bytes(600))
        assert fuzzer.line.feed(framing, fuzzer.line.encode(framing, b"a frame~}")) == [b"a frame~}"]


def test_a_failure_names_the_input_that_caused_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(fuzzer: Fuzzer) -> None:
        if fuzzer.inputs == 7:
            raise ZeroDivisionError

    monkeypatch.setitem(SURFACES, "fails", fails)
    with pytest.raises(ZeroDivisionError) as caught:
        Chunk("fails", 3, 10).run()
    assert caught.value.__notes__ == ["surface fails, seed 3, input 7"]


def test_an_interrupted_run_continues_and_parts_share_the_work(tmp_path: Path) -> None:
    record = tmp_path / "fuzz.jsonl"
    assert fuzzing.run(fuzzing.chunks(120, 10), record, (1, 2)) == 60
    assert fuzzing.run(fuzzing.chunks(120, 10), record, (1, 2)) == 0
    assert fuzzing.run(fuzzing.chunks(120, 10), record) == 60
    assert sorted(fuzzing.finished(record), key=lambda chunk: chunk.seed) == list(fuzzing.chunks(120, 10))


def test_totals_of_some_surfaces_leave_those_of_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    totals = tmp_path / "totals.jsonl"
    for surface, inputs in (("decoder", 20), ("legacy", 30), ("decoder", 40)):
        arguments = ["--surfaces", surface, "--inputs", str(inputs), "--record", str(tmp_path / f"{surface}{inputs}")]
        monkeypatch.setattr("sys.argv", ["fuzzing", *arguments, "--totals", str(totals)])
        fuzzing.main()
    rows = [json.loads(line) for line in totals.read_text().splitlines()]
    assert rows == [{"surface": "decoder", "inputs": 40}, {"surface": "legacy", "inputs": 30}]


@pytest.mark.proof
@pytest.mark.timeout(24 * 3600)
def test_a_hundred_million_inputs() -> None:
    """`UDP_MESH_FUZZ_INPUTS` of them, an equal part for each surface, under seeds of this run."""
    first_seed = int.from_bytes(os.urandom(4), "big")
    for chunk in fuzzing.chunks(INPUTS):
        chunk._replace(seed=first_seed + chunk.seed).run()
