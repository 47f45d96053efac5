"""hwsim's group masks: they overlap exactly where the graph has an edge, also while they are being changed."""

from __future__ import annotations

from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.errors import InputError
from meshlab.hwsim_groups import GROUP_BITS, assign, clique_cover, transition

Edges = set[tuple[str, str]]


def graphs(least: int, most: int, *, close: bool) -> st.SearchStrategy[tuple[list[str], Edges]]:
    """Any graph of few nodes; with `close`, nodes on a strip that hear each other up to a distance, as radios do."""

    def graph(values: list[int], choices: list[bool], reach: int) -> tuple[list[str], Edges]:
        names = [f"n{number}" for number in range(len(values))]
        pairs = list(combinations(range(len(values)), 2))
        kept = (
            [pair for pair in pairs if abs(values[pair[0]] - values[pair[1]]) <= reach]
            if close
            else [pair for pair, choice in zip(pairs, choices, strict=False) if choice]
        )
        return names, {(names[a], names[b]) for a, b in kept}

    return st.builds(
        graph,
        st.lists(st.integers(0, 100), min_size=least, max_size=most),
        st.lists(st.booleans(), min_size=most * most // 2, max_size=most * most // 2),
        st.integers(0, 40),
    )


def overlapping(masks: dict[str, int]) -> set[frozenset[str]]:
    return {frozenset((a, b)) for a, b in combinations(masks, 2) if masks[a] & masks[b]}


def unordered(edges: Edges) -> set[frozenset[str]]:
    return {frozenset(edge) for edge in edges}


@given(graphs(0, 11, close=False) | graphs(12, 30, close=True))
def test_masks_overlap_exactly_where_the_graph_has_an_edge(graph: tuple[list[str], Edges]) -> None:
    names, edges = graph
    masks = assign(names, edges)
    assert list(masks) == names
    assert all(0 <= mask < 1 << GROUP_BITS for mask in masks.values())
    assert overlapping(masks) == unordered(edges)


@given(graphs(12, 16, close=False) | graphs(12, 40, close=True))
def test_cliques_cover_every_edge_and_nothing_else(graph: tuple[list[str], Edges]) -> None:
    names, edges = graph
    joined: dict[str, set[str]] = {name: set() for name in names}
    for a, b in edges:
        joined[a].add(b)
        joined[b].add(a)
    cliques = clique_cover(names, joined)
    assert {frozenset(pair) for clique in cliques for pair in combinations(clique, 2)} == unordered(edges)
    assert len(cliques) <= len(edges)


@given(st.data(), st.sampled_from([(2, 9, False), (12, 20, True)]))
def test_no_transition_step_links_a_pair_that_is_unlinked_before_and_after(
    data: st.DataObject, shape: tuple[int, int, bool]
) -> None:
    _, most, close = shape
    names, before = data.draw(graphs(most, most, close=close))
    _, after = data.draw(graphs(most, most, close=close))
    masks, wanted = assign(names, before), assign(names, after)
    allowed = unordered(before) | unordered(after)
    for name, mask in transition(masks, wanted):
        masks[name] = mask
        assert overlapping(masks) <= allowed
    assert masks == wanted
    assert transition(wanted, wanted) == []


def test_a_link_change_in_a_small_fleet_rewrites_only_its_two_endpoints() -> None:
    names = [f"n{number}" for number in range(11)]
    all_pairs = set(combinations(names, 2))
    written = transition(assign(names, all_pairs), assign(names, all_pairs - {("n3", "n7")}))
    assert {name for name, _ in written} == {"n3", "n7"}


def test_forty_nodes_that_all_hear_each_other_need_one_group() -> None:
    names = [f"n{number}" for number in range(40)]
    assert set(assign(names, set(combinations(names, 2))).values()) == {1}


def test_a_graph_that_needs_too_many_groups_is_rejected_with_the_number() -> None:
    names = [f"n{number}" for number in range(66)]
    with pytest.raises(InputError, match="66 radios and 65 links need 65 groups, hwsim has 64"):
        assign(names, [("n0", name) for name in names[1:]])


def test_an_edge_to_an_unknown_node_raises_value_error() -> None:
    with pytest.raises(ValueError, match="edge a-z"):
        assign(["a"], [("a", "z")])
