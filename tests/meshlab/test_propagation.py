"""Radio propagation: properties of the path-loss model, and the file format."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.inventory.yaml_entries import share_of
from meshctl.placement.ground import NodePosition
from meshctl.placement.path_loss import DEAF_LOSS, PathLossModel, Wall, frame_loss, received_dbm
from meshlab import propagation_file
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.spec import LinkSpec

FILE = "ground.yaml"
EXAMPLES = Path(__file__).parents[2] / "inventory" / "lab"
coordinates = st.integers(-400, 400).map(float)
points = st.tuples(coordinates, coordinates)
names = st.sampled_from([f"n{number}" for number in range(8)])
powers = st.none() | st.integers(0, 33).map(float)
links = st.builds(
    LinkSpec,
    st.sampled_from(["n0", "n1"]),
    st.sampled_from(["n2", "n3", "n4"]),
    loss=st.sampled_from([0.0, 0.25, 1.0]),
    loss_back=st.sampled_from([None, 0.1, 1.0]),
    up=st.booleans(),
    rate_kbps=st.none() | st.integers(1, 1000),
    broadcast_kbps=st.none() | st.integers(1, 1000),
)
grounds = st.builds(
    RadioEnvironment,
    st.dictionaries(names, st.builds(NodePosition, points, powers), max_size=8),
    st.lists(st.builds(Wall, points, points, st.sampled_from([3.0, 40.0, 100.0])), max_size=3).map(tuple),
    st.builds(PathLossModel, exponent=st.sampled_from([1.8, 3.5, 5.0]), fading_db=st.sampled_from([0.5, 2.0])),
    st.lists(links, max_size=3, unique_by=lambda link: link.ends).map(tuple),
)


def loss_at(distance_m: float, air: PathLossModel = PathLossModel(), walls_db: float = 0.0) -> float:  # noqa: B008
    return frame_loss(air, received_dbm(air, distance_m, air.tx_power_dbm, walls_db))


def test_frame_loss_is_10_percent_at_sensitivity_and_the_first_meter_is_free_space() -> None:
    air = PathLossModel()
    assert frame_loss(air, air.sensitivity_dbm) == 0.1
    first_meter = received_dbm(replace(air, antenna_gain_dbi=0.0), 1.0, 0.0)
    wavelength_m = 299_792_458 / 2.437e9
    assert first_meter == pytest.approx(20 * math.log10(wavelength_m / (4 * math.pi)))
    assert received_dbm(air, 100.0, 24.0) == pytest.approx(received_dbm(air, 10.0, 24.0) - 35.0)


@given(st.floats(0.0, 1000.0), st.floats(0.0, 100.0), st.floats(0.0, 50.0))
def test_loss_never_decreases_with_distance_or_wall_attenuation(near_m: float, more_m: float, rock_db: float) -> None:
    assert loss_at(near_m + more_m) >= loss_at(near_m)
    assert loss_at(near_m, walls_db=rock_db) >= loss_at(near_m)


@given(grounds)
def test_each_audible_pair_is_linked_exactly_once(ground: RadioEnvironment) -> None:
    found = links_of(ground)
    assert len({link.ends for link in found}) == len(found)
    by_hand = {link.ends for link in ground.links}
    for link in found:
        losses = (link.loss_to(link.a), link.loss_to(link.b))
        if link.ends not in by_hand:
            # in hundredths: 0.896 is 0.9
            assert min(losses) <= DEAF_LOSS
            assert all(loss <= DEAF_LOSS or loss == 1.0 for loss in losses)


@given(grounds)
def test_a_manual_link_applies_regardless_of_node_positions(ground: RadioEnvironment) -> None:
    assert set(ground.links) <= set(links_of(ground))


@given(grounds, points)
def test_moving_a_node_does_not_change_links_between_other_nodes(
    ground: RadioEnvironment, to: tuple[float, float]
) -> None:
    if "n0" not in ground.positions:
        with pytest.raises(InputError, match="n0: it has no position"):
            ground.with_moved("n0", to)
        return
    before = [link for link in links_of(ground) if "n0" not in link.ends]
    assert [link for link in links_of(ground.with_moved("n0", to)) if "n0" not in link.ends] == before


def test_the_weaker_sender_is_not_heard_by_the_stronger_one() -> None:
    ground = RadioEnvironment({"strong": NodePosition((0, 0), 33.0), "weak": NodePosition((330, 0), 15.0)})
    (link,) = links_of(ground)
    assert link.loss_to("weak") < 0.5
    assert link.loss_to("strong") == 1.0
    assert link.signal_at("weak") - link.signal_at("strong") == 18
    assert link.tq_to("weak") == link.tq_to("strong") == 0


def test_a_wall_between_two_nodes_separates_them_and_one_beside_them_does_not() -> None:
    ground = RadioEnvironment({"a": NodePosition((0, 0)), "b": NodePosition((40, 0))})
    assert len(links_of(replace(ground, walls=(Wall((20, -10), (20, 10)),)))) == 0
    assert len(links_of(replace(ground, walls=(Wall((20, 5), (20, 10)),)))) == 1
    assert len(links_of(replace(ground, walls=(Wall((20, -10), (20, 10), 6.0),)))) == 1


# -- the file --


def test_an_environment_file_is_parsed() -> None:
    text = """
nodes: {base: [0, 0], b01: {at: [80, 0.5], tx_power_dbm: 33}}
walls: [{a: [40, 10], b: [200, 10], loss_db: 40}, {a: [0, 0], b: [1, 1]}]
air: {exponent: 2, sensitivity_dbm: -90}
links:
  - {between: [base, b02], loss: 30%, loss_back: 0.05, delay_ms: 5, rate_kbps: 64, broadcast_kbps: 8}
  - {between: [b01, b02], up: false}
"""
    assert propagation_file.parse(text, FILE) == RadioEnvironment(
        {"base": NodePosition((0, 0)), "b01": NodePosition((80, 0.5), 33.0)},
        (Wall((40, 10), (200, 10), 40.0), Wall((0, 0), (1, 1))),
        PathLossModel(exponent=2.0, sensitivity_dbm=-90.0),
        (
            LinkSpec("base", "b02", loss=0.3, loss_back=0.05, delay_ms=5.0, rate_kbps=64, broadcast_kbps=8),
            LinkSpec("b01", "b02", up=False),
        ),
    )


def test_the_links_example_has_no_positions() -> None:
    ground = propagation_file.load(EXAMPLES / "links.yaml")
    assert ground.positions == {}
    assert links_of(ground)[0] == LinkSpec("base", "b01", tq=252, signal_dbm=-52)


def test_the_ground_example_forms_a_chain_with_a_robot_at_two_nodes() -> None:
    pairs = {"-".join(sorted(link.ends)) for link in links_of(propagation_file.load(EXAMPLES / "ground.yaml"))}
    assert pairs == {"b01-base", "b01-b02", "b02-b03", "b01-rover1", "b03-rover2"}


@given(grounds)
def test_an_environment_round_trips_through_its_file(ground: RadioEnvironment) -> None:
    assert propagation_file.parse(propagation_file.dump(ground), FILE) == ground


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nodes: {a: [0]}", "ground.yaml:1:12: nodes.a: expected [x, y] in meters, found a list of 1 [INV021]"),
        (
            "nodes:\n  a: {at: [0, x]}",
            "ground.yaml:2:15: nodes.a.at[1]: expected a number from -1e+06 to 1e+06, found 'x'",
        ),
        ("nodes:\n  a: {tx_power_dbm: 9}", "ground.yaml:2:6: nodes.a: expected the key at, found no such key [INV022]"),
        ("walls:\n  - {a: [0, 0]}", "ground.yaml:2:5: walls[0]: expected the key b"),
        ("walls: 7", "ground.yaml:1:8: walls: expected a list, found '7'"),
        ("air: {exponent: 0}", "ground.yaml:1:17: air.exponent: expected a number from 1 to 10, found '0'"),
        ("air: {colour: red}", "ground.yaml:1:7: air: expected one of tx_power_dbm,"),
        ("links:\n- {between: [a, b]}\n- {between: [b, a]}", "ground.yaml:3:3: links[1]: expected each pair once"),
        ("links: [{between: [a, a]}]", "ground.yaml:1:19: links[0].between: expected two different nodes"),
        ("links: [{between: [a, b], loss: 130%}]", "expected a share from 0 to 1, or 0% to 100%, found '130%'"),
        ("links: [{between: [a, b], up: maybe}]", "expected one of true, false, found 'maybe'"),
        ("links: [{between: [a, b], tq: 2.5}]", "expected an integer from 0 to 255, found '2.5'"),
        ("place: {}", "ground.yaml:1:1: expected one of nodes, walls, air, links, found 'place'"),
        ("[1, 2]", "ground.yaml:1:1: expected a mapping, found a list of 2"),
        # the text of a key file, for example
        ("f772a084226a36ec", "ground.yaml:1:1: expected a mapping, found a single value"),
        ("nodes: {a: [0, 0}", "ground.yaml:1:17: not valid YAML"),
        ("nodes: {a: [0, 0], a: [1, 1]}", "ground.yaml:1:20: duplicate key 'a'"),
    ],
)
def test_a_parse_error_reports_file_line_expected_and_found(text: str, said: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        propagation_file.parse(text, FILE)
    assert said in str(caught.value)


def test_all_problems_are_reported_at_once() -> None:
    with pytest.raises(InvalidInput) as caught:
        propagation_file.parse("nodes: {a: 1, b: [0, y]}\nair: {exponent: x}\nmore: 1", FILE)
    assert len(caught.value.diagnostics) == 4


@given(st.text(max_size=200))
def test_any_text_parses_or_raises_diagnostics(text: str) -> None:
    try:
        propagation_file.parse(text, FILE)
    except InvalidInput as problems:
        assert problems.diagnostics


@pytest.mark.parametrize(("text", "share"), [("30%", 0.3), ("0.3", 0.3), ("100%", 1.0), ("0", 0.0)])
def test_a_share_is_a_number_or_a_percentage(text: str, share: float) -> None:
    assert share_of(text) == pytest.approx(share)


@pytest.mark.parametrize("text", ["30", "-1%", "nan", "%", "", "1.01"])
def test_an_invalid_share_is_none(text: str) -> None:
    assert share_of(text) is None
