"""Settings from a program that has no type checker: a wrong type is an error where it is written."""

from collections.abc import Callable
from typing import Any

import pytest

from udp_mesh.core.settings import Limits, Log, Neighbour, Outbox, Rates, RelaySettings, Settings, Topic
from udp_mesh.crypto import Key

KEY = Key(bytes(range(32)))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"outbox": "none"}, "topic map: outbox: expected one of Outbox.NONE, Outbox.LAST, Outbox.ALL, found 'none'"),
        ({"priority": 1.5}, r"topic map: priority: expected int, found 1.5 \(float\)"),
        ({"priority": "1"}, r"topic map: priority: expected int, found '1' \(str\)"),
        ({"destinations": "base"}, r"topic map: destinations: expected a tuple of str, found 'base' \(str\)"),
        ({"reliable": "false"}, r"topic map: reliable: expected bool, found 'false' \(str\)"),
        ({"reliable": ()}, "topic map: reliable: expected bool, found tuple"),
        ({"keep_last": 1.5}, r"topic map: keep_last: expected int, found 1.5 \(float\)"),
        ({"deadline_s": "1"}, r"topic map: deadline_s: expected float, found '1' \(str\)"),
        ({"deadline_s": True}, r"topic map: deadline_s: expected float, found True \(bool\)"),
        ({"log": ("base",)}, "topic map: log: expected Log, found tuple"),
        ({"links": "lora"}, "topic map: links: expected a tuple of str"),
        ({"name": b"map"}, "topic: expected str, found bytes"),
    ],
)
def test_a_topic_with_a_value_of_the_wrong_type_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        Topic(**{"name": "map", **values})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"keys": ("00" * 32,)}, "keys: expected Key, found str$"),
        ({"keys": "00" * 32}, "keys: expected a tuple of Key, found str$"),
        ({"keys": KEY}, "keys: expected a tuple of Key, found Key$"),
        ({"topics": ("map",)}, "topics: expected Topic, found 'map'"),
        ({"topics": Topic("map")}, "topics: expected a tuple of Topic, found Topic"),
        ({"neighbours": (("127.0.0.1", 8700),)}, "neighbours: expected Neighbour, found tuple"),
        ({"port": "8700"}, "port: expected int, found '8700'"),
        ({"window": "3"}, "window: expected int, found '3'"),
        ({"limits": Rates()}, "limits: expected Limits, found Rates"),
        ({"name": 3}, r"name: expected str, found 3 \(int\)"),
    ],
)
def test_settings_with_a_value_of_the_wrong_type_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        Settings(**{"name": "ugv1", "keys": (KEY,), **values})


@pytest.mark.parametrize("port", [0, -1, 65_536])
def test_a_port_that_no_socket_can_have_is_refused(port: int) -> None:
    with pytest.raises(ValueError, match=f"port: expected 1 to 65535, found {port}"):
        Settings("ugv1", port=port, keys=(KEY,))


def test_text_in_place_of_a_list_of_names_is_not_taken_for_letters() -> None:
    name: Any = "base"
    with pytest.raises(TypeError, match=r"log.readers: expected a tuple of str"):
        Log(readers=name)
    with pytest.raises(TypeError, match="relay names: expected a tuple of str"):
        RelaySettings(names=name)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda wrong: Rates(heartbeat_s=wrong), r"rates.heartbeat_s: expected float, found '1' \(str\)"),
        (lambda wrong: Limits(peers=wrong), "limits.peers: expected int, found '1'"),
        (lambda wrong: Neighbour(wrong), r"neighbor address: expected \(str, int\), found '1'"),
        (lambda wrong: Neighbour(("127.0.0.1", wrong)), "neighbor address: expected int, found '1'"),
    ],
)
def test_parts_of_settings_are_checked_too(make: Callable[[Any], object], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        make("1")


def test_lists_are_accepted_in_place_of_tuples() -> None:
    values: Any = {"keys": [KEY], "topics": [Topic("map", outbox=Outbox.LAST)]}
    assert Settings("ugv1", **values).topics[0].name == "map"


@pytest.mark.parametrize("text", [None, b"00" * 32])
def test_a_key_that_is_no_text_is_named(text: Any) -> None:
    with pytest.raises(TypeError, match="key: expected text, found "):
        Key.parse(text)
