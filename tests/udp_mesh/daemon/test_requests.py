"""Requests of local clients: invalid names are refused with the reason, and long replies arrive complete."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests.udp_mesh.daemon.processes import RunningDaemon, collect, outcomes, two_daemons
from udp_mesh.client import MeshError
from udp_mesh.client.mesh_client import MAX_HEADER_BYTES, encode_frame

Pair = tuple[RunningDaemon, RunningDaemon]

pytestmark = pytest.mark.xdist_group("udp_mesh_requests")


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with two_daemons(alice_more="[undeclared]\npriority = 9\n") as daemons:
        yield daemons


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"topic": "a b"}, "topic: expected a topic of 1 to 255 bytes without spaces, found 'a b'"),
        ({"topic": "x" * 256}, "topic: expected a topic of 1 to 255 bytes"),
        ({"topic": "status", "type": "a\nb"}, "type: expected printable text of at most 255 bytes, found 'a\\nb'"),
        ({"topic": "status", "type": "x" * 256}, "type: expected printable text of at most 255 bytes"),
        (
            {"topic": "status", "to": "a b"},
            "to: expected a name of 1 to 63 bytes without spaces or slashes, found 'a b'",
        ),
        ({"topic": "status", "type": "x" * MAX_HEADER_BYTES}, "expected at most 65536 bytes"),
    ],
)
def test_an_invalid_name_is_rejected_and_later_messages_are_delivered(
    pair: Pair, fields: dict[str, Any], complaint: str
) -> None:
    alice, bob = pair
    with alice.client() as client, bob.client() as receiver:
        receiver.subscribe("status")
        with pytest.raises(MeshError) as refused:
            client.request("publish", b"x", **fields)
        assert refused.value.code == "bad-request"
        assert complaint in str(refused.value)
        number = client.publish("status", b"after", to="bob", notify=True)
        assert outcomes(client, 1) == {number: "delivered"}
        assert collect(receiver, 1)[0].payload == b"after"


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"address": "bob"}, "neighbor.address: expected an IP address"),
        ({"address": "fe80::1"}, 'expected link = "INTERFACE" with a link-local address'),
        ({"address": "fd00::1", "name": "x", "legacy": True}, "expected an IPv4 address"),
        ({"address": "10.0.0.1", "legacy": True}, "expected a name"),
        ({"address": "10.0.0.1", "name": "a b"}, "neighbor.name: expected a name of 1 to 63 bytes"),
    ],
)
def test_a_neighbor_invalid_in_the_configuration_file_cannot_be_set(
    pair: Pair, fields: dict[str, Any], complaint: str
) -> None:
    with pair[0].client() as client:
        with pytest.raises(MeshError) as refused:
            client.request("set-neighbor", **fields)
        assert refused.value.code == "bad-request"
        assert complaint in str(refused.value)
        assert len(client.request("neighbours")["neighbours"]) == 1


def test_the_status_of_a_large_team_arrives(pair: Pair) -> None:
    robots = {f"robot{number}" for number in range(200)}
    with pair[0].client() as client:
        client.request("set-topic", topic="report", values={"outbox": "last"})
        for robot in robots:
            client.publish("report", b"x", to=robot)
        status = client.request("status")
    assert robots <= {peer["name"] for peer in status["conditions"]["peers"]}
    assert len(encode_frame(status)) > MAX_HEADER_BYTES
