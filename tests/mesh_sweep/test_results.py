"""The results file's lines: what is written is read, a torn line is repaired, other content is refused."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mesh_sweep.cases import Case
from mesh_sweep.errors import SweepError
from mesh_sweep.results import Identity, Result, decode, encode, encode_all
from mesh_sweep.results_file import ResultsFile

OURS = Identity("mine", "0123456789abcdef", "1.0-abc")
ONE = Result(Case((("a", "1"),), 1), {"x": 0.5, "y": None})
TWO = Result(Case((("a", "1"),), 2), {"x": 1.5, "y": 3.0})
CASES = st.builds(
    Case,
    st.lists(st.tuples(st.text(min_size=1), st.text()), unique_by=lambda one: one[0]).map(
        lambda all_: tuple(sorted(all_))
    ),
    st.integers(0, 10**9),
)
RESULTS = st.builds(
    Result,
    CASES,
    st.dictionaries(
        st.text(), st.none() | st.integers() | st.floats(allow_nan=False, allow_infinity=False), min_size=1
    ),
)


@given(st.lists(RESULTS, unique_by=lambda one: one.case), st.randoms())
def test_results_are_read_as_written_in_any_order(results: list[Result], shuffle: object) -> None:
    raw = encode_all(OURS, results)
    stored = decode(raw, "f", OURS)
    assert sorted(stored.results, key=repr) == sorted(results, key=repr)
    assert encode_all(OURS, reversed(results)) == raw


def test_a_line_that_is_torn_anywhere_is_left_out() -> None:
    whole, line = encode(OURS, ONE), encode(OURS, TWO)
    for length in range(len(line)):
        stored = decode(whole + line[:length], "f", OURS)
        assert stored.results == (ONE,)
        assert stored.size == len(whole)


@pytest.mark.parametrize(
    ("raw", "problem"),
    [
        (
            b"precious",
            "f:1: expected a result of scenario mine (0123456789abcdef) at revision 1.0-abc, found 'precious'",
        ),
        (
            b"precious\n",
            "f:1: expected a result of a sweep (one JSON object), found 'precious'; if the file is damaged, "
            "remove this line, and its case runs again",
        ),
        (b"[1]\n", "f:1: expected a result of a sweep (one JSON object), found '[1]'"),
        (b'{"scenario": "mine"}\n', "f:1: expected a result of a sweep (one JSON object)"),
        (encode(OURS, ONE) + b"\xff\n", "f:2: expected a result of a sweep"),
        (
            encode(Identity("mine", "f" * 16, "1.0-abc"), ONE),
            "f:1: expected results of scenario mine (0123456789abcdef) at revision 1.0-abc, found those of scenario "
            "mine (ffffffffffffffff) at revision 1.0-abc: give another --out for these, or remove the file",
        ),
        (encode(OURS, ONE) + encode(OURS, Result(ONE.case, {"x": 9.0})), "found two results of a=1, seed 1"),
    ],
)
def test_other_content_is_refused(raw: bytes, problem: str) -> None:
    with pytest.raises(SweepError) as raised:
        decode(raw, "f", OURS)
    assert problem in str(raised.value)


def test_figures_replace_a_failure_and_never_the_other_way_round() -> None:
    failed = Result(ONE.case, failed="killed")
    for lines in ((failed, ONE), (ONE, failed)):
        raw = b"".join(encode(OURS, one) for one in lines)
        assert decode(raw, "f", OURS).results == (ONE,)


def test_the_file_is_repaired_locked_appended_and_sorted(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    path.write_bytes(encode(OURS, TWO) + encode(OURS, ONE)[:50])
    with ResultsFile(path, OURS) as file:
        assert file.stored.results == (TWO,)
        assert file.repaired_bytes == 50
        with pytest.raises(SweepError, match="another sweep is writing this file"), ResultsFile(path, OURS):
            pass
        file.append(ONE)
        assert path.read_bytes() == encode(OURS, TWO) + encode(OURS, ONE)
        file.finish([TWO, ONE])
    assert path.read_bytes() == encode(OURS, ONE) + encode(OURS, TWO)
    assert [one.name for one in tmp_path.iterdir()] == ["r.jsonl"]


def test_a_link_to_the_results_stays(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    path, target = tmp_path / "r.jsonl", tmp_path / "disk/results.jsonl"
    path.symlink_to(target)
    with ResultsFile(path, OURS) as file:
        file.append(TWO)
        file.append(ONE)
        file.finish([TWO, ONE])
    assert path.is_symlink()
    assert target.read_bytes() == encode(OURS, ONE) + encode(OURS, TWO)


def test_a_refused_file_keeps_its_content(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_bytes(b"notes without an end")
    with pytest.raises(SweepError), ResultsFile(path, OURS):
        pass
    assert path.read_bytes() == b"notes without an end"


def test_a_full_disk_is_reported_with_the_file_and_tears_at_most_one_line(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with ResultsFile(path, OURS) as file:
        file.append(ONE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, limits[1]))
        try:
            with pytest.raises(SweepError) as raised:
                file.append(TWO)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert str(raised.value) == f"{path}: File too large; the results so far are kept, and the same command continues"
    with ResultsFile(path, OURS) as file:
        assert file.stored.results == (ONE,)
        assert file.repaired_bytes == 20


def test_a_device_is_no_results_file() -> None:
    with pytest.raises(SweepError, match="expected a regular file"), ResultsFile(Path("/dev/zero"), OURS):
        pass
