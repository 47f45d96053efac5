"""A trial notes what happens over time, and its picture shows it."""

import random
from statistics import fmean
from xml.etree import ElementTree

import pytest

from benchmarks.link_pictures import IMAGES, file_name, picture
from udp_mesh.sim.links.bbr import Bbr
from udp_mesh.sim.links.cells import UNFAMILIAR
from udp_mesh.sim.links.path import Link
from udp_mesh.sim.links.traces import Steps, constant
from udp_mesh.sim.links.trial import Cell, Result, Trial

FADE_S = (4.0, 4.5)


@pytest.fixture(scope="module")
def result() -> Result:
    """Six seconds of load on 4 Mbit/s, then 2 Mbit/s, beside a TCP flow, with a fade."""
    rate = Steps((0.0, FADE_S[0], FADE_S[1], 6.0), (4e6, 0.0, 4e6, 2e6))
    cell = Cell(
        "short",
        lambda seed: Link(rate, constant(0.01)),
        foreign=lambda seed: Bbr(random.Random(seed)),
        duration_s=6.0,
        warm_up_s=1.0,
    )
    return Trial(cell, 1).run()


def test_a_timeline_shows_the_rate_of_the_link_and_who_used_it(result: Result) -> None:
    timeline = result.timeline
    assert [moment.at_s for moment in timeline] == pytest.approx([0.5 * step for step in range(1, 13)])
    assert [moment.link_bits_per_s for moment in timeline] == pytest.approx([4e6] * 4 + [0.0] + [4e6] * 3 + [2e6] * 4)
    # Only what was in flight before the fade.
    assert timeline[4].goodput_bits_per_s + timeline[4].foreign_bits_per_s < 0.4e6
    measured = timeline[2:]
    carried = fmean(moment.link_bits_per_s or 0.0 for moment in measured)
    assert fmean(moment.goodput_bits_per_s for moment in measured) == pytest.approx(result.share * carried)
    assert fmean(moment.foreign_bits_per_s for moment in measured) == pytest.approx(result.foreign_share * carried)


def test_a_timeline_has_the_urgent_messages_of_the_fade_too(result: Result) -> None:
    in_fade = [latency_s for sent_s, latency_s in result.urgent_at if FADE_S[0] - 2.0 <= sent_s < FADE_S[1] - 2.1]
    assert len(in_fade) >= 7
    assert max(in_fade) > 0.35


def test_a_picture_is_well_formed_and_draws_every_series(result: Result) -> None:
    root = ElementTree.fromstring(picture(result))
    text = "".join(root.itertext())
    assert all(name in text for name in ("goodput", "foreign flow", "rate of the link", "urgent latency, ms"))
    lines = [path for path in root.iter("{http://www.w3.org/2000/svg}path") if path.get("fill") == "none"]
    assert len(lines) == 4


def test_every_unfamiliar_link_has_a_picture() -> None:
    assert {path.name for path in IMAGES.glob("*.svg")} == {file_name(cell.name) for cell in UNFAMILIAR}
