"""Ranges of names."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.inventory.ranges import MAX_NAMES, BadRange, expand


@given(st.integers(0, 500), st.integers(0, 50), st.integers(1, 5))
def test_a_span_expands_to_every_number_zero_padded_like_its_first(low: int, more: int, width: int) -> None:
    first = str(low).zfill(width)
    names = expand(f"b[{first}-{low + more}]x")
    assert [int(name[1:-1]) for name in names] == list(range(low, low + more + 1))
    assert names[0] == f"b{first}x"
    assert all(len(name) >= len(first) + 2 for name in names)


@given(st.text(alphabet="b[]0123456789-,. ab", max_size=30))
def test_any_pattern_gives_distinct_names_or_is_refused(pattern: str) -> None:
    try:
        names = expand(pattern)
    except BadRange as reason:
        assert str(reason)
    else:
        assert 0 < len(names) <= MAX_NAMES
        assert len(set(names)) == len(names)


def test_lists_spans_and_words_mix() -> None:
    assert expand("b[1,3-4,x]") == ("b1", "b3", "b4", "bx")
    assert expand("plain") == ("plain",)


@pytest.mark.parametrize("pattern", ["b[]", "b[1-]", "b[2-1]", "b[1,1]", "b[[1]]", "b]", "b[1-100001]", "[1-999]" * 9])
def test_an_invalid_range_is_rejected(pattern: str) -> None:
    with pytest.raises(BadRange):
        expand(pattern)
