"""A radio without a frame for some tenths of a second: its queue keeps what was sent into the outage, and afterwards
the whole link is used again."""

from __future__ import annotations

import pytest

from udp_mesh.sim.links.path import Link
from udp_mesh.sim.links.traces import Steps, constant
from udp_mesh.sim.links.trial import MEET_S, Cell, Trial

STARTS_AT_S, MEASURED_FROM_S, MEASURED_UNTIL_S = 3.0, 3.5, 4.5
"""After the start of the load."""


@pytest.mark.parametrize("rate", [6e6, 24e6, 54e6])
@pytest.mark.parametrize("outage_s", [0.15, 0.3, 0.5])
def test_the_link_is_used_again_soon_after_an_outage(rate: float, outage_s: float) -> None:
    start = MEET_S + STARTS_AT_S
    course = Steps((0.0, start, start + outage_s), (rate, 0.0, rate))
    link = Link(course, constant(0.005), queue_packets=300)
    cell = Cell("outage", lambda seed: link, duration_s=MEASURED_UNTIL_S + 1.0, warm_up_s=1.0)
    result = Trial(cell, 1).run()
    steps = [moment for moment in result.timeline if MEASURED_FROM_S < moment.at_s - 0.25 < MEASURED_UNTIL_S]
    carried = sum(moment.link_bits_per_s or 0.0 for moment in steps)
    assert len(steps) == 2
    # .65 to .97 where the round trips of an outage count as those of the path
    assert sum(moment.goodput_bits_per_s for moment in steps) / carried > 0.84
