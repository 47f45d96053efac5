"""Reduced messages: the throttle, images and clouds of both versions of ROS, and the detail that the link allows."""

from __future__ import annotations

import contextlib
import itertools
import math
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from udp_mesh.bridges.configuration import BridgeConfigurationError, parse_configuration
from udp_mesh.bridges.message_codec import Numbers, decode, encode
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.mixed_team import ros2_type
from udp_mesh.bridges.names import Route
from udp_mesh.bridges.reduction import (
    CLOUD,
    IMAGE,
    JPEG,
    JpegOptions,
    Reduced,
    Reducer,
    Reduction,
    ReductionError,
    Throttle,
    jpeg_quality,
    voxel_edge_m,
)
from udp_mesh.bridges.ros2.quality import Quality, parse_quality, quality_text
from udp_mesh.bridges.types import TypeKey

HEADER = {"stamp": (12, 34), "frame_id": "camera"}
ROUTE = Route("camera", "base")
Version = Literal[1, 2]


def key_of(name: str, version: Version) -> TypeKey:
    if version == 1:
        return TypeKey(name, TYPES[name].md5sum)
    return TypeKey(ros2_type(name), quality_text(Quality("best_effort", "volatile", 5, "RIHS01_" + "ab" * 32)))


def reduced(reduction: Reduction, name: str, message: dict[str, Any], version: Version) -> Reduced:
    reducer = Reducer({"camera": reduction}, version)
    payload = encode(TYPES[name], message, version)
    definition = TYPES[name].text if version == 1 else ""
    found = reducer.reduce(ROUTE, key_of(name, version), definition, payload, 0.0)
    assert found is not None
    return found


def image(encoding: str, pixel: tuple[int, ...], width: int = 40, height: int = 30, padding: int = 3) -> dict[str, Any]:
    line = bytes(pixel) * width + b"\xee" * padding
    return {
        "header": HEADER, "height": height, "width": width, "encoding": encoding, "step": len(line),
        "data": Numbers("B", line * height),
    }  # fmt: skip


# The throttle


@given(st.floats(0.5, 10), st.floats(11, 60))
def test_a_throttle_passes_its_rate_evenly(rate_hz: float, source_hz: float) -> None:
    throttle = Throttle(rate_hz)
    times = [number / source_hz for number in range(int(20 * source_hz))]
    passed = [now for now in times if throttle.passes(now)]
    assert abs(len(passed) - 20 * rate_hz) <= 1 + 20 * rate_hz * rate_hz / source_hz
    assert all(later - sooner > 1 / rate_hz - 1 / source_hz - 1e-9 for sooner, later in itertools.pairwise(passed))


def test_a_pause_is_not_followed_by_a_burst() -> None:
    throttle = Throttle(1.0)
    assert throttle.passes(0.0)
    assert [now for now in (100.0, 100.1, 100.2, 101.0, 101.5) if throttle.passes(now)] == [100.0, 101.0]


def test_each_destination_has_a_throttle_and_latched_messages_pass() -> None:
    reducer = Reducer({"camera": Reduction(rate_hz=1.0)}, 1)
    key = TypeKey("std_msgs/String", "0" * 32)
    assert reducer.reduce(ROUTE, key, "d", b"1", 0.0) == Reduced(key, "d", b"1")
    assert reducer.reduce(ROUTE, key, "d", b"2", 0.1) is None
    assert reducer.reduce(ROUTE, key, "d", b"3", 0.1, latched=True) is not None
    assert reducer.reduce(Route("camera", None), key, "d", b"4", 0.1) is not None
    assert reducer.reduce(Route("other", "base"), key, "d", b"5", 0.1) is not None


# Images


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("encoding", "pixel", "expected"),
    [
        ("rgb8", (250, 120, 10), (250, 120, 10)),
        ("bgr8", (10, 120, 250), (250, 120, 10)),
        ("rgba8", (250, 120, 10, 0), (250, 120, 10)),
        ("bgra8", (10, 120, 250, 9), (250, 120, 10)),
        ("mono8", (77,), 77),
    ],
)
def test_an_image_becomes_a_scaled_jpeg(
    version: Version, encoding: str, pixel: tuple[int, ...], expected: tuple[int, ...] | int
) -> None:
    found = reduced(Reduction(encode=JpegOptions(quality=90, scale=0.5)), IMAGE, image(encoding, pixel), version)
    assert found.key.name == (JPEG if version == 1 else "sensor_msgs/msg/CompressedImage")
    message = decode(TYPES[JPEG], found.payload, version)
    assert message["format"] == "jpeg"
    assert (message["header"]["stamp"], message["header"]["frame_id"]) == ((12, 34), "camera")
    made = Image.open(BytesIO(message["data"].data))
    assert (made.format, made.size) == ("JPEG", (20, 15))
    middle = numpy.asarray(made)[7, 10]
    assert numpy.allclose(middle, expected, atol=4), f"{middle}, not {expected}"


def test_in_ros_1_the_new_type_comes_with_its_definition_and_md5sum() -> None:
    found = reduced(Reduction(encode=JpegOptions()), IMAGE, image("rgb8", (1, 2, 3)), 1)
    assert found.key == TypeKey(JPEG, "8f7a12909da2c9d3332d540a0977563f")
    assert found.definition == TYPES[JPEG].text


def test_in_ros_2_the_quality_of_service_stays_and_the_hash_of_another_type_does_not() -> None:
    quality = parse_quality(reduced(Reduction(encode=JpegOptions()), IMAGE, image("rgb8", (1, 2, 3)), 2).key.checksum)
    assert quality == Quality("best_effort", "volatile", 5, "")


@pytest.mark.parametrize("form", ["JPEG", "PNG"])
def test_a_compressed_image_is_encoded_again(form: str) -> None:
    noise = numpy.random.default_rng(1).integers(0, 255, (120, 160, 3), dtype=numpy.uint8)
    out = BytesIO()
    Image.fromarray(noise).save(out, form)
    message = {"header": HEADER, "format": form.lower(), "data": Numbers("B", out.getvalue())}
    sizes = []
    for quality in (80, 10):
        found = reduced(Reduction(encode=JpegOptions(quality=quality, scale=0.5)), JPEG, message, 1)
        data = decode(TYPES[JPEG], found.payload, 1)["data"].data
        assert Image.open(BytesIO(data)).size == (80, 60)
        sizes.append(len(data))
    assert sizes[1] < sizes[0] / 2


BAD_IMAGES = [
    (IMAGE, {**image("rgb8", (1, 2, 3)), "step": 10}),
    (IMAGE, {**image("rgb8", (1, 2, 3)), "height": 1000}),
    (IMAGE, image("16UC1", (1, 2))),
    (IMAGE, {}),
    (JPEG, {"format": "jpeg", "data": Numbers("B", b"no image")}),
    (JPEG, {"format": "16UC1; compressedDepth png", "data": Numbers("B", b"")}),
    (CLOUD, {}),
]


@pytest.mark.parametrize(("name", "message"), BAD_IMAGES)
def test_what_is_no_image_is_refused(name: str, message: dict[str, Any]) -> None:
    with pytest.raises(ReductionError):
        reduced(Reduction(encode=JpegOptions()), name, message, 1)


def test_another_definition_of_the_type_is_refused() -> None:
    reducer = Reducer({"camera": Reduction(encode=JpegOptions())}, 1)
    with pytest.raises(ReductionError, match="md5sum"):
        reducer.reduce(ROUTE, TypeKey(IMAGE, "0" * 32), "", b"", 0.0)


# Clouds


def cloud(points: list[tuple[float, float, float, int]], *, order: str = "<", row_padding: int = 0) -> dict[str, Any]:
    """x, y, z and the ring, between them four bytes that belong to no field; one row."""
    layout = numpy.dtype({"names": ["x", "y", "z", "ring"], "formats": [order + "f4"] * 3 + [order + "u2"],
                          "offsets": [0, 4, 8, 16], "itemsize": 20})  # fmt: skip
    data = numpy.array(points, layout).tobytes() + bytes(row_padding)
    fields = [{"name": name, "offset": at, "datatype": kind, "count": 1}
              for name, at, kind in (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 16, 4))]  # fmt: skip
    return {
        "header": HEADER, "height": 1, "width": len(points), "fields": fields, "is_bigendian": order == ">",
        "point_step": 20, "row_step": len(data), "data": Numbers("B", data), "is_dense": 0,
    }  # fmt: skip


POINTS = [
    (0.01, 0.01, 0.01, 1),
    (0.09, 0.09, 0.09, 2),
    (-0.01, 0.0, 0.0, 3),
    (math.nan, 0.0, 0.0, 4),
    (5.0, 5.0, 5.0, 5),
    (0.05, 0.0, 0.0, 6),
]


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_cloud_keeps_the_first_point_of_each_voxel(version: Version, order: str) -> None:
    found = reduced(Reduction(voxel_m=0.1), CLOUD, cloud(POINTS, order=order, row_padding=12), version)
    assert found.key == key_of(CLOUD, version)
    message = decode(TYPES[CLOUD], found.payload, version)
    assert (message["height"], message["width"], message["row_step"]) == (1, 3, 60)
    assert [field["name"] for field in message["fields"]] == ["x", "y", "z", "ring"]
    rings = numpy.frombuffer(message["data"].data, numpy.uint8).reshape(3, 20)[:, 16:18].copy().view(order + "u2")
    assert rings[:, 0].tolist() == [1, 3, 5]


def test_only_the_named_fields_of_a_cloud_are_kept() -> None:
    message = decode(TYPES[CLOUD], reduced(Reduction(fields=("ring", "z")), CLOUD, cloud(POINTS), 1).payload, 1)
    assert [(field["name"], field["offset"]) for field in message["fields"]] == [("ring", 0), ("z", 2)]
    assert (message["width"], message["point_step"], message["row_step"]) == (6, 6, 36)
    points = numpy.frombuffer(message["data"].data, numpy.dtype([("ring", "<u2"), ("z", "<f4")]))
    assert points["ring"].tolist() == [1, 2, 3, 4, 5, 6]
    assert points["z"][4] == 5.0


def test_an_empty_cloud_stays_one() -> None:
    message = decode(TYPES[CLOUD], reduced(Reduction(voxel_m=1.0, fields=("x",)), CLOUD, cloud([]), 1).payload, 1)
    assert (message["width"], message["data"].data) == (0, b"")


@pytest.mark.parametrize(
    ("change", "reduction"),
    [
        ({"row_step": 10}, Reduction(voxel_m=0.1)),
        ({"height": 9}, Reduction(voxel_m=0.1)),
        ({"point_step": 0}, Reduction(voxel_m=0.1)),
        ({"fields": []}, Reduction(voxel_m=0.1)),
        (
            {"fields": [{"name": axis, "offset": 18, "datatype": 7, "count": 1} for axis in "xyz"]},
            Reduction(voxel_m=0.1),
        ),
        ({}, Reduction(fields=("intensity",))),
    ],
)
def test_what_is_no_such_cloud_is_refused(change: dict[str, Any], reduction: Reduction) -> None:
    with pytest.raises(ReductionError):
        reduced(reduction, CLOUD, {**cloud(POINTS), **change}, 1)


def test_voxels_beyond_the_numbers_are_refused() -> None:
    with pytest.raises(ReductionError, match="too wide"):
        reduced(Reduction(voxel_m=0.001), CLOUD, cloud([(0.0, 0.0, 0.0, 1), (1e9, 1e9, 1e9, 2)]), 1)


@given(st.binary(max_size=200), st.sampled_from([IMAGE, JPEG, CLOUD]), st.sampled_from([1, 2]))
def test_any_bytes_are_reduced_or_refused(data: bytes, name: str, version: Version) -> None:
    reducer = Reducer({"camera": Reduction(encode=JpegOptions(), voxel_m=0.1)}, version)
    with contextlib.suppress(ReductionError):
        reducer.reduce(ROUTE, key_of(name, version), "", data, 0.0)


# The detail


def test_quality_and_voxels_stay_within_their_bounds() -> None:
    options = JpegOptions(quality=60, min_quality=10)
    assert [jpeg_quality(options, detail) for detail in (0.0, 0.5, 1.0)] == [10, 35, 60]
    assert jpeg_quality(JpegOptions(quality=5, min_quality=10), 0.0) == 5
    cloud_options = Reduction(voxel_m=0.1, max_voxel_m=0.4)
    assert [round(voxel_edge_m(cloud_options, detail) or 0, 6) for detail in (0.0, 0.5, 1.0)] == [0.4, 0.2, 0.1]
    assert voxel_edge_m(Reduction(voxel_m=0.1), 0.0) == 0.1


# The bridge's file


def test_reductions_are_read_from_the_bridges_file() -> None:
    text = """
    topics:
      camera: { rate_hz: 1, encode: { quality: 40, min_quality: 5, scale: 0.5 }, adapt: true }
      cloud: { rate_hz: 2, voxel_m: 0.2, max_voxel_m: 1, fields: [x, y, z] }
      map: { depth: 5 }
    """
    assert parse_configuration(text, "bridge.yaml").reductions == {
        "camera": Reduction(1.0, JpegOptions(40, 5, 0.5), adapt=True),
        "cloud": Reduction(2.0, None, 0.2, 1.0, ("x", "y", "z")),
    }


def test_the_guides_example_is_read_and_reduces_a_camera_and_a_cloud() -> None:
    guide = Path(__file__).parents[3] / "docs" / "bridges.md"
    text = guide.read_text().partition("## Fewer and smaller messages")[2].partition("```yaml\n")[2].partition("```")[0]
    reducer = Reducer(parse_configuration(text, "bridge.yaml").reductions, 1)
    for topic, name, message in (("camera", IMAGE, image("rgb8", (1, 2, 3))), ("cloud", CLOUD, cloud(POINTS))):
        payload = encode(TYPES[name], message, 1)
        found = reducer.reduce(Route(topic, None), key_of(name, 1), TYPES[name].text, payload, 0.0)
        assert found is not None
        assert found.payload != payload
        assert reducer.adapts(topic)


@pytest.mark.parametrize(
    ("topic", "place"),
    [
        ("{ rate_hz: 0 }", "topics.t.rate_hz"),
        ("{ encode: { quality: 101 } }", "topics.t.encode.quality"),
        ("{ encode: { scale: 2 } }", "topics.t.encode.scale"),
        ("{ encode: { colour: 2 } }", "topics.t.encode.colour"),
        ("{ fields: x }", "topics.t.fields"),
        ("{ adapt: true, encode: {} }", "topics.t.adapt"),
        ("{ adapt: true, rate_hz: 1 }", "topics.t.adapt"),
        ("{ voxel_m: 0.5, max_voxel_m: 0.1 }", "topics.t.max_voxel_m"),
    ],
)
def test_a_wrong_reduction_is_reported_with_its_place(topic: str, place: str) -> None:
    with pytest.raises(BridgeConfigurationError, match=rf"bridge.yaml:1:\d+: {place}: expected"):
        parse_configuration(f"topics: {{ t: {topic} }}", "bridge.yaml")
