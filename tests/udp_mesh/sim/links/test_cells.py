"""The transport on familiar and unfamiliar links in virtual time: shares and latencies that must not get worse.

The runs are exact for a seed. Bounds leave a margin of about .02 in the share and a tenth in latency over what was
measured, so that a change of the timing alone does not fail; `python -m benchmarks.unfamiliar_links` measures more
seeds.
"""

import pytest

from udp_mesh.sim.links.cells import CELLS, FAMILIAR, UNFAMILIAR
from udp_mesh.sim.links.trial import Result, Trial

BOUNDS = {
    # name: (seed, least share, longest p99 of urgent messages in ms)
    "0 %": (1, 0.93, 21),
    "20 %": (1, 0.91, 40),
    "100 ms, 0 %": (1, 0.93, 70),
    "20 to 60 ms": (1, 0.84, 55),
    "half duplex": (1, 0.87, 15),
    "600 ms, 2 %": (2, 0.92, 380),
    "wifi rate walk": (1, 0.88, 48),
    "route 10 and 150 ms, MTU hole": (1, 0.81, 125),
    "four senders": (1, 0.92, 21),
    "1 Mbit/s, 5 %": (1, 0.82, 60),
    "three half-duplex hops": (1, 0.80, 46),
}
FAIR = {"beside cubic": (1, 0.35, 0.65), "beside BBR": (1, 0.35, 0.65)}
"""name: (seed, least and largest share)."""


def result(name: str, seed: int) -> Result:
    return Trial(CELLS[name], seed).run()


@pytest.mark.parametrize("name", BOUNDS)
def test_share_and_latency_stay_within_their_bounds(name: str) -> None:
    seed, least_share, longest_ms = BOUNDS[name]
    found = result(name, seed)
    assert found.share > least_share
    assert found.urgent_p99_s() * 1e3 < longest_ms
    # Urgent messages of a reliable topic all arrive, however the link behaves.
    assert len(found.urgent_s) == found.urgent_sent


@pytest.mark.parametrize("name", FAIR)
def test_a_foreign_flow_and_ours_share_the_link(name: str) -> None:
    seed, least, largest = FAIR[name]
    found = result(name, seed)
    assert least < found.share < largest
    assert found.share + found.foreign_share > 0.9
    assert len(found.urgent_s) == found.urgent_sent


def test_every_unfamiliar_link_has_a_bound() -> None:
    assert {cell.name for cell in UNFAMILIAR} <= {*BOUNDS, *FAIR}
    assert {*BOUNDS, *FAIR} <= {cell.name for cell in (*FAMILIAR, *UNFAMILIAR)}


def test_a_trial_is_the_same_for_a_seed() -> None:
    first, again = (result("three half-duplex hops", 3) for _ in range(2))
    assert (first.share, first.urgent_s) == (again.share, again.urgent_s)
