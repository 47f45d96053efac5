"""Laws that hold for every tree and every text."""

from __future__ import annotations

from contextlib import suppress
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.diagnostics import InvalidInput
from meshctl.uci import Package, Section, apply, diff, dump, parse, parse_export, quote
from tests.meshctl.uci.trees import packages, values


@given(packages())
def test_a_dumped_tree_parses_back_to_itself(tree: Package) -> None:
    assert parse(dump(tree), "network") == tree
    assert parse_export(dump(tree, header=True), "export") == (tree,)


@given(packages())
def test_dump_is_a_fixed_point_of_parse(tree: Package) -> None:
    assert dump(parse(dump(tree), "network")) == dump(tree)


@given(values)
def test_a_quoted_value_arrives_unchanged_as_a_list_item(value: str) -> None:
    text = f"config t\n\tlist x {quote(value)}\n"
    assert parse(text, "x").sections[0].items("x") == (value,)


few_types = st.sampled_from(["rule", "zone"])


@given(packages(few_types), packages(few_types))
def test_applying_a_difference_gives_the_other_tree(before: Package, after: Package) -> None:
    change = diff(before, after)
    assert apply(change, before) == after
    assert bool(change) == (before != after)


@given(packages(few_types), st.randoms(use_true_random=False))
def test_a_diff_of_reordered_sections_applies_exactly(before: Package, random: Random) -> None:
    sections = list(before.sections)
    random.shuffle(sections)
    after = Package(before.name, tuple(sections))
    assert apply(diff(before, after), before) == after


@given(st.text(st.sampled_from("colp ntigs'\"\\#;\n\t\rax1_é"), max_size=60))
def test_any_text_parses_or_raises_an_error_with_a_position(text: str) -> None:
    try:
        tree = parse(text, "fuzz")
    except InvalidInput as error:
        place = error.diagnostics[0].position
        assert place.line >= 1
        assert place.column >= 1
        assert place.line <= text.count("\n") + 1
    else:
        assert parse(dump(tree), "fuzz") == tree


@given(st.binary(max_size=80))
def test_any_bytes_parse_or_raise_invalid_input(raw: bytes) -> None:
    with suppress(InvalidInput):
        parse(raw.decode("utf-8", "surrogateescape"), "fuzz")


def test_a_nul_is_refused_by_quote_and_by_the_tree() -> None:
    with pytest.raises(ValueError, match="NUL"):
        quote("a\0b")
    with pytest.raises(ValueError, match="NUL"):
        Section("t", None, {"x": "a\0b"})
