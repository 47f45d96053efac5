"""Planned beacons: the fewest, with the margin everywhere, on walls and on occupancy maps; bad maps name the place."""

from __future__ import annotations

import json
import math
import re
import xml.etree.ElementTree as ElementTree
import zlib
from itertools import combinations, pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from meshctl.cli.main import build
from meshctl.diagnostics import InvalidInput
from meshctl.inventory.yaml_entries import read
from meshctl.placement import ground, occupancy_map
from meshctl.placement.path_loss import (
    PathLossModel,
    SubtModel,
    Wall,
    packet_error,
    received_dbm,
    walls_between,
)
from meshctl.placement.picture import MapView, png, svg
from meshctl.placement.planner import Walls, plan

GROUND = Path(__file__).parents[3] / "inventory" / "lab" / "ground.yaml"
AIR = PathLossModel()


def covered(beacons: tuple[float, ...], places: list[float], margin_db: float) -> bool:
    """Whether every place of a straight route has the margin to the base or a beacon, and each beacon to the last."""
    nodes = [0.0, *beacons]

    def margin(a: float, b: float) -> float:
        return received_dbm(AIR, abs(a - b), AIR.tx_power_dbm) - AIR.noise_dbm - AIR.required_snr_db

    chained = all(margin(a, b) >= margin_db for a, b in pairwise(nodes))
    return chained and all(any(margin(node, place) >= margin_db for node in nodes) for place in places)


@pytest.mark.parametrize("length_m", [40.0, 90.0, 130.0, 170.0])
def test_no_smaller_number_of_beacons_covers_a_straight_drift(length_m: float) -> None:
    found = plan(Walls(()), AIR, [(0.0, 0.0), (length_m, 0.0)])
    assert found.is_complete
    assert covered(tuple(one.depth_m for one in found.beacons), [depth for depth, _, _ in found.steps], 10.0)
    assert all(margin >= 10.0 for _, _, margin in found.steps)
    if found.beacons:
        coarse = [float(place) for place in range(0, round(length_m) + 1, 5)]
        fewer = combinations(coarse, len(found.beacons) - 1)
        assert not any(covered(chosen, coarse, 10.0) for chosen in fewer)


def test_a_beacon_stands_where_it_sees_both_arms_of_a_bend() -> None:
    walls = Walls((Wall((2.0, -2.0), (60.0, -2.0), 30.0), Wall((-2.0, -60.0), (60.0, -60.0), 100.0)))
    found = plan(walls, AIR, [(30.0, 0.0), (0.0, 0.0), (0.0, -40.0)])
    assert found.is_complete
    assert len(found.beacons) == 1
    assert math.dist(found.beacons[0].at, (0.0, 0.0)) < 5.0


def test_a_route_through_rock_ends_where_no_place_helps() -> None:
    found = plan(Walls((Wall((20.0, -10.0), (20.0, 10.0)),)), AIR, [(0.0, 0.0), (60.0, 0.0)])
    assert not found.is_complete
    assert found.covered_m == pytest.approx(20.0, abs=1.0)


def test_a_stock_that_is_too_small_says_how_far_it_carries() -> None:
    whole = plan(Walls(()), AIR, [(0.0, 0.0), (300.0, 0.0)])
    less = plan(Walls(()), AIR, [(0.0, 0.0), (300.0, 0.0)], beacons=len(whole.beacons) - 2)
    assert whole.is_complete
    assert len(less.beacons) == len(whole.beacons) - 2
    assert less.covered_m < 300.0


# DARPA's model


def test_walls_steepen_the_decay_of_the_simulators_model() -> None:
    air = SubtModel()
    wall = Wall((0.0, 0.0), (1.0, 0.0), visibility_cost=5.0)
    assert air.power_dbm(10.0, 27.0, ()) == pytest.approx(27 - 40 - 25)
    assert air.power_dbm(10.0, 27.0, (wall,)) == pytest.approx(27 - 40 - 35)
    assert air.power_dbm(10.0, 27.0, (wall,) * 3) > -math.inf
    assert air.power_dbm(10.0, 27.0, (wall,) * 4) == -math.inf
    assert air.power_dbm(501.0, 27.0, ()) == -math.inf
    # QPSK: BER = erfc(sqrt(P / N)), PER = 1 - (1 - BER)^bits
    assert packet_error(3.0, bits=1) == pytest.approx(math.erfc(math.sqrt(10**0.3)))
    assert packet_error(air.required_snr_db) == pytest.approx(0.5, abs=1e-3)
    assert air.loss(-50.0) == 0.0
    assert air.loss(-100.0) == air.loss(-math.inf) == 1.0


@given(st.floats(-120, -40), st.floats(0, 20))
def test_a_stronger_signal_loses_no_more(strength: float, more: float) -> None:
    for air in (AIR, SubtModel()):
        assert air.loss(strength + more) <= air.loss(strength)


@given(st.lists(st.tuples(*[st.floats(-50, 50)] * 4), max_size=8), st.tuples(*[st.floats(-50, 50)] * 4))
def test_the_search_for_walls_finds_what_the_geometry_says(
    ends: list[tuple[float, float, float, float]], line: tuple[float, float, float, float]
) -> None:
    walls = tuple(Wall((x0, y0), (x1, y1)) for x0, y0, x1, y1 in ends)
    a, b = (line[0], line[1]), (line[2], line[3])

    def side(p: tuple[float, float], q: tuple[float, float], r: tuple[float, float]) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    crossing = [
        wall
        for wall in walls
        if side(a, b, wall.a) * side(a, b, wall.b) < 0 and side(wall.a, wall.b, a) * side(wall.a, wall.b, b) < 0
    ]
    assert list(walls_between(walls, a, b)) == crossing


def test_a_ground_file_chooses_its_model() -> None:
    assert ground.parse("air: {model: subt, exponent: 1.5}", "g.yaml").air == SubtModel(exponent=1.5)
    with pytest.raises(InvalidInput, match=re.escape("g.yaml:1:14: air.model: expected one of log-distance, subt")):
        ground.parse("air: {model: itu}", "g.yaml")
    with pytest.raises(InvalidInput, match="expected one of tx_power_dbm, noise_dbm"):
        ground.parse("air: {model: subt, fading_db: 2}", "g.yaml")


# Occupancy maps

YAML = (
    "image: mine.pgm\nresolution: 0.5\norigin: [-1.0, -2.0, 0.0]\n"
    "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)
ROWS = [
    "##########",
    "#........#",
    "#.######.#",
    "#.#????#.#",
    "##########",
]


def written(tmp_path: Path, rows: list[str] = ROWS, *, kind: str = "P5", text: str = YAML) -> Path:
    """The map as map_server saves it: free 254, occupied 0, unknown 205."""
    values = [{"#": 0, ".": 254, "?": 205}[letter] for row in rows for letter in row]
    head = f"{kind}\n# CREATOR: map_saver.cpp 0.500 m/pix\n{len(rows[0])} {len(rows)}\n255\n".encode()
    body = bytes(values) if kind == "P5" else " ".join(map(str, values)).encode()
    (tmp_path / "mine.pgm").write_bytes(head + body)
    (tmp_path / "mine.yaml").write_text(text)
    return tmp_path / "mine.yaml"


@pytest.mark.parametrize("kind", ["P5", "P2"])
def test_a_map_is_read_with_its_origin_at_the_lower_left(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, kind=kind)
    found = occupancy_map.read_map(read(path), path)
    assert (found.columns, found.rows, found.cell_m) == (10, 5, 0.5)
    assert found.is_free(1, 3)
    assert found.is_free(1, 1)
    assert not found.is_free(4, 1)
    assert found.cell((-0.25, -1.25)) == (1, 1)
    assert found.center(1, 1) == (-0.25, -1.25)
    # from one arm to the other: rock once
    assert found.wall_count(found.center(1, 1), found.center(8, 1)) == 1
    assert found.wall_count(found.center(1, 3), found.center(8, 3)) == 0
    way = found.way((found.center(1, 1), found.center(8, 1)))
    assert all(found.is_free(*found.cell(place)) for place in way)
    assert sum(math.dist(a, b) for a, b in pairwise(way)) > 4.5


def test_fine_pixels_are_merged_without_losing_a_thin_wall(tmp_path: Path) -> None:
    rows = ["." * 9 + "#" + "." * 10] * 20
    path = written(tmp_path, rows, text=YAML.replace("resolution: 0.5", "resolution: 0.05"))
    found = occupancy_map.read_map(read(path), path)
    assert (found.columns, found.rows) == (4, 4)
    assert [found.is_free(column, 1) for column in range(4)] == [True, False, True, True]


@pytest.mark.parametrize(
    ("text", "image", "complaint"),
    [
        (YAML.replace("0.5\n", "fine\n"), None, "mine.yaml:2:13: resolution: expected a number from 0.0001 to 10"),
        (YAML.replace(", 0.0]", "]"), None, "mine.yaml:3:9: origin: expected [x, y, yaw], found a list of 2"),
        (YAML.replace("0.0]", "0.3]"), None, "mine.yaml:3:9: origin: expected a yaw of 0, found 0.3"),
        (YAML.replace("negate", "negated"), None, "mine.yaml:4:1: expected one of image, resolution"),
        ("image: mine.pgm\n", None, "expected the key resolution"),
        (YAML, b"\x89PNG", "mine.pgm:1:1: expected a PGM image (P5 or P2)"),
        (YAML, b"P5\n10 x\n", "mine.pgm:2:1: expected height, found no number"),
        (YAML, b"P5\n# only\n10 5\n255\n1234", "mine.pgm:4:1: expected 50 pixels, found 4: the file is cut off"),
        (YAML, b"P5\n10 5\n65535\n" + bytes(100), "mine.pgm:3:1: expected a white of 1 to 255, found 65535"),
        (YAML, b"P2\n2 1\n9\n3 10", "mine.pgm:3:1: expected pixels of at most 9, found 10"),
        (YAML, b"P5\n0 5\n255\n", "mine.pgm:3:1: expected 1 to 64000000 pixels, found 0 x 5"),
    ],
)
def test_a_bad_map_names_file_and_line(tmp_path: Path, text: str, image: bytes | None, complaint: str) -> None:
    path = written(tmp_path, text=text)
    if image is not None:
        (tmp_path / "mine.pgm").write_bytes(image)
    result = CliRunner().invoke(build("plan-placement"), ["plan-placement", str(path), "0,0", "1,1"])
    assert result.exit_code == 2
    assert complaint in result.output


# The command


def test_the_command_prints_the_same_plan_as_table_json_and_csv(tmp_path: Path) -> None:
    words = ["plan-placement", str(GROUND), "base", "240,0", "240,-60"]
    pictures = ["--svg", str(tmp_path / "p.svg"), "--png", str(tmp_path / "p.png")]
    result = CliRunner().invoke(build("plan-placement"), [*words, "--json", *pictures])
    assert result.exit_code == 0
    document = json.loads(result.output)
    assert document["complete"]
    assert document["length_m"] == document["covered_m"] == 300.0
    csv = CliRunner().invoke(build("plan-placement"), [*words, "--csv"]).output.splitlines()
    assert csv[0] == "number,depth_m,x_m,y_m,margin_db"
    assert len(csv) == 1 + len(document["beacons"])
    text = CliRunner().invoke(build("plan-placement"), words).output
    assert f"{len(document['beacons'])} beacons: 300 of 300 m with a margin of 10 dB" in text
    root = ElementTree.parse(tmp_path / "p.svg").getroot()
    texts = ["".join(one.itertext()) for one in root if one.tag.endswith("text")]
    labels = [f"{one['number']}{one['margin_db']:.0f} dB" for one in document["beacons"]]
    assert texts[: 1 + len(labels)] == ["base", *labels]
    assert "300 of 300 m" in texts[1 + len(labels)]
    # no label stands on the summary
    heights = [float(one.attrib["y"]) for one in root if one.tag.endswith("text")]
    assert min(heights[: 1 + len(labels)]) - heights[1 + len(labels)] >= 20
    # the scale has the length that it states
    bar = next(one.attrib["d"] for one in root if one.attrib.get("fill") == "none")
    start, end = (float(word) for word in re.findall(r"M([\d.]+) .*H([\d.]+)", bar)[0])
    length_m = int(next(text for text in texts if re.fullmatch(r"\d+ m", text)).split()[0])
    beacons = [float(one.attrib["d"][1:].split()[0]) for one in root if one.attrib.get("d", "").endswith("z")]
    apart_m = document["beacons"][1]["x_m"] - document["beacons"][0]["x_m"]
    assert (end - start) / length_m == pytest.approx((beacons[1] - beacons[0]) / apart_m, rel=1e-3)
    raw = (tmp_path / "p.png").read_bytes()
    width, height = int.from_bytes(raw[16:20]), int.from_bytes(raw[20:24])
    start = raw.index(b"IDAT") + 4
    pixels = zlib.decompress(raw[start : start + int.from_bytes(raw[start - 8 : start - 4])])
    assert len(pixels) == height * (3 * width + 1)


def test_too_few_beacons_are_a_finding() -> None:
    words = ["plan-placement", str(GROUND), "base", "240,0", "--beacons", "1"]
    result = CliRunner().invoke(build("plan-placement"), words)
    assert result.exit_code == 1
    assert "the margin ends at" in result.output


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["base"], "expected a route of two points at least"),
        (["base", "b09"], "route: expected X,Y in meters or one of base, b01"),
        (["base", "1,2,3"], "route: expected X,Y in meters"),
        (["base", "1,1e9"], "route: expected X,Y within 10,000 km"),
        (["base", "b01", "--svg", "/nowhere/p.svg"], "cannot write /nowhere/p.svg: No such file or directory"),
    ],
)
def test_a_wrong_route_is_an_error(words: list[str], complaint: str) -> None:
    result = CliRunner().invoke(build("plan-placement"), ["plan-placement", str(GROUND), *words])
    assert result.exit_code == 2
    assert complaint in result.output


def test_a_picture_does_not_overwrite_the_map(tmp_path: Path) -> None:
    path = written(tmp_path)
    image = path.parent / "mine.pgm"
    before = {file: file.read_bytes() for file in (path, image)}
    way = [",".join(map(str, occupancy_map.read_map(read(path), path).center(*at))) for at in ((1, 1), (8, 1))]
    for option, file in (("--svg", path), ("--png", image)):
        result = CliRunner().invoke(build("plan-placement"), ["plan-placement", str(path), *way, option, str(file)])
        assert result.exit_code == 2
        assert "is an input of this command, and would be overwritten" in result.output
    assert {file: file.read_bytes() for file in before} == before


def test_coordinates_may_begin_with_a_minus_sign() -> None:
    words = ["plan-placement", str(GROUND), "-20,-5", "-1.5,0", "--json"]
    result = CliRunner().invoke(build("plan-placement"), words)
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["length_m"] == 19.2


def test_an_occupancy_map_is_drawn_below_its_plan(tmp_path: Path) -> None:
    path = written(tmp_path)
    found = occupancy_map.read_map(read(path), path)
    way = found.way((found.center(1, 1), found.center(8, 1)))
    planned = plan(Walls(()), AIR, way)
    view = MapView(occupancy=found)
    # the page, the rock in runs, the base
    assert svg(view, planned).count("<rect") == 1 + 10 + 1
    assert png(view, planned).startswith(b"\x89PNG")


def test_an_inventory_in_place_of_a_map_is_one_error() -> None:
    inventory = GROUND.parents[1] / "community" / "fleet.yaml"
    with pytest.raises(InvalidInput) as raised:
        ground.load(inventory)
    (found,) = raised.value.diagnostics
    assert found.text == "expected a map: a file with nodes, walls or air, found an inventory"
