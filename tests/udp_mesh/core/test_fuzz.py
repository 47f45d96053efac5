"""Any bytes at every decoder of the network: frames within their caps, or a counted drop, never an exception.

`make test` runs 4,000 inputs per surface. The proof runs `UDP_MESH_FUZZ_INPUTS` inputs over all surfaces, 10^8 by
default. `benchmarks/results/fuzz.jsonl` has the totals of the largest run.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.udp_mesh.core import fuzzing
from tests.udp_mesh.core.fuzzing import (
    SURFACES,
    Chunk,
    Fuzzer,
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
    for surface in (relay_frames, log_messages, subscriptions, versions):
        fuzzer.run(surface, 1000)
    fuzzer.check_bounds()
    assert fuzzer.relay.works()
    assert fuzzer.logs.works()
    assert fuzzer.messages.works()


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
    assert fuzzing.run(120, record, (1, 2), chunk_inputs=10) == 60
    assert fuzzing.run(120, record, (1, 2), chunk_inputs=10) == 0
    assert fuzzing.run(120, record, chunk_inputs=10) == 60
    assert sorted(fuzzing.finished(record), key=lambda chunk: chunk.seed) == list(fuzzing.chunks(120, 10))


@pytest.mark.proof
@pytest.mark.timeout(24 * 3600)
def test_a_hundred_million_inputs() -> None:
    """`UDP_MESH_FUZZ_INPUTS` of them, an equal part for each surface, under seeds of this run."""
    first_seed = int.from_bytes(os.urandom(4), "big")
    for chunk in fuzzing.chunks(INPUTS):
        chunk._replace(seed=first_seed + chunk.seed).run()
