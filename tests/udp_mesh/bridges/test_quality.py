"""ROS 2's quality of service, as it crosses the mesh."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.ros2.quality import Quality, common, in_order_of_arrival, parse_quality, quality_text, ros2_name

QUALITIES = st.builds(
    Quality,
    st.sampled_from(["reliable", "best_effort"]),
    st.sampled_from(["volatile", "transient_local"]),
    st.integers(1, 99),
    st.just("") | st.from_regex("RIHS01_[0-9a-f]{64}", fullmatch=True),
)


@given(QUALITIES)
def test_a_qos_profile_round_trips_through_its_text(quality: Quality) -> None:
    assert parse_quality(quality_text(quality)) == quality


def test_an_invalid_qos_profile_is_none() -> None:
    good = quality_text(Quality())
    assert parse_quality(good) is not None
    for text in (
        "",
        "reliable:volatile:10",
        "reliable:volatile:0:",
        "reliable:volatile:x:",
        "a:volatile:1:",
        good + "RIHS",
    ):
        assert parse_quality(text) is None


@given(st.lists(QUALITIES, min_size=1, max_size=5))
def test_a_subscription_requests_only_qos_that_every_publisher_offers(qualities: list[Quality]) -> None:
    asked = common(qualities)
    assert (asked.reliability == "reliable") == all(quality.reliability == "reliable" for quality in qualities)
    assert asked.latched == all(quality.latched for quality in qualities)


def test_names_are_converted_to_valid_ros_2_names() -> None:
    assert ros2_name("/ugv__1/mesh_comm/a___b/x_y") == "/ugv_1/mesh_comm/a_b/x_y"


def test_the_publisher_that_came_last_is_last_whatever_order_the_graph_has() -> None:
    killed, other, new = (b"\5", "std_msgs/msg/String"), (b"\7", "std_msgs/msg/String"), (b"\1", "std_msgs/msg/Int32")
    first = in_order_of_arrival({}, dict([killed, other]))
    second = in_order_of_arrival(first, dict([new, killed, other]))
    assert list(second.items()) == [killed, other, new]
    assert list(in_order_of_arrival(second, dict([new, other])).items()) == [other, new]
    assert in_order_of_arrival(second, dict([other])) == dict([other])
