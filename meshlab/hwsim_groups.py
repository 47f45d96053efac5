"""Link graph -> a 64-bit group mask per radio for mac80211_hwsim: radios hear each other if their masks share a bit.

`assign` computes the masks of a graph; `transition` orders the writes from old masks to new ones so that no two radios
hear each other meanwhile unless they are linked before or after.

A bit is a clique: all radios that have it hear each other. Up to 11 nodes, every pair has its own bit, independent of
the graph, so that changing a link touches two masks and no other link. For more nodes the graph's edges are covered by
cliques, greedily (a minimal cover is NP-hard: Kou, Stockmeyer and Wong, CACM 21(2), 1978).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from meshctl.errors import InputError

# drivers/net/wireless/virtual/mac80211_hwsim.c: `u64 group` in struct mac80211_hwsim_data
GROUP_BITS = 64
# 11 * 10 / 2 = 55 pairs fit, 12 * 11 / 2 = 66 do not
_PAIRED_NODES = 11


def assign(nodes: Sequence[str], edges: Iterable[tuple[str, str]]) -> dict[str, int]:
    """A mask for each of `nodes`: two masks overlap if and only if `edges` join the nodes; 0 for an isolated node.

    Raises InputError when more than 64 groups are needed, ValueError for an unknown node.
    """
    place = {name: number for number, name in enumerate(nodes)}
    joined: dict[str, set[str]] = {name: set() for name in nodes}
    for a, b in edges:
        if a not in place or b not in place:
            raise ValueError(f"edge {a}-{b}: not among the nodes")
        if a != b:
            joined[a].add(b)
            joined[b].add(a)
    masks = dict.fromkeys(nodes, 0)
    if len(nodes) <= _PAIRED_NODES:
        for name in nodes:
            for other in joined[name]:
                masks[name] |= 1 << _pair_bit(place[name], place[other])
        return masks
    cliques = clique_cover(nodes, joined)
    if len(cliques) > GROUP_BITS:
        edge_count = sum(map(len, joined.values())) // 2
        raise InputError(
            f"{len(nodes)} radios and {edge_count} links need {len(cliques)} groups, hwsim has {GROUP_BITS}",
            hint="use fewer nodes, fewer links, or nodes in denser clusters",
        )
    for bit, clique in enumerate(cliques):
        for name in clique:
            masks[name] |= 1 << bit
    return masks


def clique_cover(nodes: Sequence[str], joined: Mapping[str, set[str]]) -> list[list[str]]:
    """Cliques that cover every edge of the graph, each sorted in the order of `nodes`.

    Each clique starts at the first uncovered edge and grows by the node that adds most uncovered edges.
    """
    place = {name: number for number, name in enumerate(nodes)}
    left = {name: set(joined[name]) for name in nodes}
    cliques = []
    for a in nodes:
        while left[a]:
            clique = [a, min(left[a], key=place.__getitem__)]
            fitting = set(joined[a]) & set(joined[clique[1]])
            while fitting:
                best = min(fitting, key=lambda name: (-len(left[name].intersection(clique)), place[name]))
                if not left[best].intersection(clique):
                    break
                clique.append(best)
                fitting &= joined[best]
            for name in clique:
                left[name].difference_update(clique)
            cliques.append(sorted(clique, key=place.__getitem__))
    return cliques


def transition(old: Mapping[str, int], new: Mapping[str, int]) -> list[tuple[str, int]]:
    """The masks to write, in order, to get from `old` to `new` one radio at a time.

    First each radio is reduced to the bits it has in both, which links no new pair; then each gets its new bits, which
    links only pairs of the new graph.
    """
    narrowed = [(name, old.get(name, 0) & mask) for name, mask in new.items() if old.get(name, 0) & ~mask]
    final = [(name, mask) for name, mask in new.items() if mask != old.get(name, 0) & mask]
    return narrowed + final


def _pair_bit(a: int, b: int) -> int:
    low, high = sorted((a, b))
    return high * (high - 1) // 2 + low
