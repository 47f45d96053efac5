"""Laws of the mesh's graph: distances, cut vertices, and what each loss cuts off."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.topology import EMPTY, Graph, Link, graph_of

NAMES = [f"n{index}" for index in range(9)]


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    pairs = draw(st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(NAMES)), max_size=18))
    qualities = draw(st.lists(st.floats(0.05, 1.0), min_size=len(pairs), max_size=len(pairs)))
    return graph_of(NAMES, [Link(a, b, quality) for (a, b), quality in zip(pairs, qualities, strict=True)])


def line(length: int) -> Graph:
    names = [f"n{index}" for index in range(length)]
    return graph_of(names, [Link(a, b, 0.9) for a, b in itertools.pairwise(names)])


def test_each_inner_node_of_a_chain_cuts_off_every_node_behind_it() -> None:
    assert line(5).cut_off_by("n0") == {"n1": ("n2", "n3", "n4"), "n2": ("n3", "n4"), "n3": ("n4",)}


def test_a_ring_has_no_cut_vertex() -> None:
    names = NAMES[:5]
    ring = graph_of(names, [Link(a, b) for a, b in zip(names, [*names[1:], names[0]], strict=True)])
    assert ring.cut_off_by("n0") == {}


@given(graphs())
def test_cut_off_nodes_match_a_reachability_search_without_the_removed_node(graph: Graph) -> None:
    entry = "n0"
    whole = graph.reachable(entry)
    slow = {
        name: tuple(sorted(whole - graph.reachable(entry, [name]) - {name}))
        for name in graph.nodes
        if name != entry and name in whole
    }
    assert graph.cut_off_by(entry) == {name: lost for name, lost in slow.items() if lost}


@given(graphs())
def test_cut_off_by_all_with_one_node_matches_cut_off_by(graph: Graph) -> None:
    cut = graph.cut_off_by("n0")
    for name in NAMES[1:]:
        assert graph.cut_off_by_all(["n0"], [name]) == frozenset(cut.get(name, ()))


@given(graphs())
def test_a_path_is_one_hop_longer_than_the_path_of_its_next_hop(graph: Graph) -> None:
    paths = graph.paths("n0")
    assert set(paths) == graph.reachable("n0")
    for name, path in paths.items():
        if name == "n0":
            assert (path.hops, path.quality) == (0, 1.0)
            continue
        link = graph.neighbors[name][path.via]
        assert path.hops == paths[path.via].hops + 1
        assert path.quality == pytest.approx(paths[path.via].quality * link.quality)


@given(graphs())
def test_farthest_first_lists_every_node_once_in_descending_hop_count(graph: Graph) -> None:
    order = graph.farthest_first("n0")
    paths = graph.paths("n0")
    assert sorted(order) == sorted(graph.nodes)
    hops = [paths[name].hops if name in paths else len(NAMES) for name in order]
    assert hops == sorted(hops, reverse=True)


def test_a_strong_detour_beats_a_weak_direct_link() -> None:
    graph = graph_of([], [Link("base", "far", 0.2), Link("base", "mid", 0.9), Link("mid", "far", 0.9)])
    assert graph.paths("base")["far"].via == "mid"
    assert graph.paths("base")["far"].hops == 2


def test_a_wire_wins_over_a_radio_link() -> None:
    graph = graph_of([], [Link("front", "rear", 0.4), Link("front", "rear", 1.0, wired=True), Link("rear", "front")])
    assert graph.links == (Link("front", "rear", 1.0, wired=True),)


def test_a_long_chain_does_not_exceed_the_recursion_limit() -> None:
    assert len(line(3000).cut_off_by("n0")) == 2998


def test_an_unknown_entry_node_reaches_no_nodes() -> None:
    assert EMPTY.paths("base") == {}
    assert EMPTY.cut_off_by("base") == {}
    assert line(2).reachable("base") == frozenset()


def test_a_quality_outside_its_range_is_refused() -> None:
    with pytest.raises(ValueError, match="a-b: quality 255"):
        graph_of([], [Link("a", "b", 255)])
