from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from types import MappingProxyType

import pytest

from meshctl.errors import InputError
from meshctl.inventory.selection import Attributes, select, select_nodes, select_one
from meshctl.model import NodeState
from tests.meshctl.plan.support import fleet

CANDIDATES: dict[str, Attributes] = {
    "base": {"role": ("base",), "group": (), "mesh": ("main",)},
    "b01": {"role": ("beacon",), "group": ("spares",), "mesh": ("main",)},
    "b02": {"role": ("beacon",), "group": ("drops", "west"), "mesh": ("main", "side")},
    "husky1": {"role": ("robot",), "group": ("west",), "mesh": ("side",)},
}
FILES = {"nothing": "# none yet\n", "run": "b01  # the first\n\nrole:base,!b02\n", "nested": "@run\n"}


def read(path: str) -> str:
    try:
        return FILES[path]
    except KeyError:
        raise FileNotFoundError(2, "No such file or directory") from None


def chosen(*words: str) -> list[str]:
    return list(select(words, CANDIDATES, read, what="managed node of lab"))


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ((), ["base", "b01", "b02", "husky1"]),
        (("b02", "base"), ["base", "b02"]),
        (("b*",), ["base", "b01", "b02"]),
        (("b0*,!b01",), ["b02"]),
        (("!role:base",), ["b01", "b02", "husky1"]),
        (("role:beacon", "husky1"), ["b01", "b02", "husky1"]),
        (("west",), ["b02", "husky1"]),
        (("group:w*", "!mesh:main"), ["husky1"]),
        (("mesh:side",), ["b02", "husky1"]),
        (("@run",), ["base", "b01"]),
        (("@run", "!base"), ["b01"]),
        ((" b01 , ,b02",), ["b01", "b02"]),
    ],
)
def test_terms_select_nodes(words: tuple[str, ...], names: list[str]) -> None:
    assert chosen(*words) == names


@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        (("h[1-20]",), range(1, 21)),
        (("h[8-11]", "!h9"), [8, 10, 11]),
        (("h[1,3,11-12],h20",), [1, 3, 11, 12, 20]),
        (("!h[2-20]",), [1]),
        (("label:H[08-10]",), [8, 9, 10]),
        (("H[08-10]",), [8, 9, 10]),
        (("h[1-3]",), [1, 2, 3]),
        (("[g-h]1[5-9]",), range(15, 20)),
        (("?[12-14]",), [12, 13, 14]),
        (("h[19-25]",), [19, 20]),
    ],
)
def test_ranges_select_all_their_names(words: tuple[str, ...], numbers: Iterable[int]) -> None:
    """As a pattern, h[1-20] is a set of characters: it would select h1 and h2 alone."""
    houses = {f"h{number}": {"label": (f"H{number:02}",)} for number in range(1, 21)}
    assert list(select(words, houses, read, what="node")) == [f"h{number}" for number in numbers]


def test_an_invalid_range_is_an_error() -> None:
    with pytest.raises(InputError, match=r"'b\[12-01\]': invalid range: descending span 12-01"):
        chosen("b[12-01]")


@pytest.mark.parametrize(
    ("words", "message", "hint"),
    [
        (("all",), "no managed node of lab matches 'all'", "for all nodes"),
        (("./valley",), "no managed node of lab matches './valley'", "-i ./valley"),
        (("role=beacon",), "no managed node of lab matches 'role=beacon'", "write role:beacon"),
        (("b1",), "no managed node of lab matches 'b1'", "did you mean 'b01'?"),
        (("wset",), "no managed node of lab matches 'wset'", "did you mean 'west'?"),
        (("rol:beacon",), "'rol:beacon': unknown attribute 'rol'", "did you mean 'role'?"),
        (("tag:west",), "'tag:west': unknown attribute 'tag'", "tags are groups: group:west"),
        (("role:becon",), "no managed node of lab has role 'becon'", "did you mean 'beacon'?"),
        (("mesh:zz",), "no managed node of lab has mesh 'zz'", "found: main, side"),
        (("b01", "!b0*"), "b01,!b0*: selects no managed node of lab", ""),
        (("!",), "'!': expected a name, a pattern, ATTRIBUTE:VALUE or !TERM", "for example"),
        (("role:",), "'role:': expected a name, a pattern, ATTRIBUTE:VALUE or !TERM", "for example"),
        (("",), "'': selects no managed node of lab", ""),
        (("@nothing",), "'@nothing': selects no managed node of lab", ""),
        (("@gone",), "@gone: cannot read the selection: No such file or directory", ""),
        (("@nested",), "nested:1: '@run': expected a name, a pattern, ATTRIBUTE:VALUE or !TERM", "for example"),
    ],
)
def test_a_term_that_selects_nothing_is_an_error(words: tuple[str, ...], message: str, hint: str) -> None:
    with pytest.raises(InputError) as caught:
        chosen(*words)
    assert str(caught.value) == message
    assert hint in (caught.value.hint or "")


@pytest.mark.parametrize(
    ("limits", "names"),
    [
        (["b0*"], ["b01", "b02"]),
        (["!b01"], ["base", "b02"]),
        (["b0*", "mesh:side"], ["b02"]),
        (["role:base,role:beacon", "!b02"], ["base", "b01"]),
    ],
)
def test_every_limit_narrows_the_selection(limits: list[str], names: list[str]) -> None:
    assert list(select(["base", "b0*"], CANDIDATES, read, limits, what="node")) == names


def test_a_limit_that_excludes_every_node_is_an_error() -> None:
    with pytest.raises(InputError, match="husky1: selects no node among those selected without it"):
        select(["b0*"], CANDIDATES, read, ["husky1"], what="node")


def test_candidates_of_two_kinds_may_share_a_name() -> None:
    """A robot's radio may have the robot's name."""
    devices: dict[tuple[str, str], Attributes] = {
        ("radio", "rover"): {"role": ("robot",)},
        ("robot", "rover"): {"role": ("computer",)},
    }

    def chosen_kinds(word: str) -> list[str]:
        name_of: Callable[[tuple[str, str]], str] = lambda device: device[1]  # noqa: E731
        return [kind for kind, _ in select([word], devices, read, what="device", name_of=name_of)]

    assert chosen_kinds("rover") == ["radio", "robot"]
    assert chosen_kinds("role:computer") == ["robot"]


def test_the_selection_can_follow_the_order_of_the_terms() -> None:
    """One --at or --interface per node, in the order of the words."""
    found = select(["b02", "b*", "!base"], CANDIDATES, read, what="node", in_word_order=True)
    assert found == ("b02", "b01")


MAC = "02:4d:00:00:00:01"


@pytest.mark.parametrize("word", ["b01", "B01", "h1-1", "label:h1-*", "sn1", MAC.upper(), f"mac:{MAC}"])
def test_a_node_is_selected_by_name_label_serial_or_mac(word: str) -> None:
    team = fleet()
    b01 = replace(team.nodes["b01"], mac=MAC, label="H1-1", serial="SN1")
    team = replace(team, nodes=MappingProxyType({**team.nodes, "b01": b01}))
    assert select_one(team, word, read).name == "b01"
    assert "b01" not in [node.name for node in select_nodes(team, [f"!{word}"], read)]


def test_a_command_for_one_node_refuses_several() -> None:
    with pytest.raises(InputError, match=r"'b0\*' selects \d nodes: expected one, found b01, b02"):
        select_one(fleet(), "b0*", read)


def test_an_unmanaged_node_is_named_with_its_state_and_never_replaced_by_a_similar_name() -> None:
    team = fleet()
    lost = replace(team.nodes["b01"], state=NodeState.LOST)
    team = replace(team, nodes=MappingProxyType({**team.nodes, "b01": lost}))
    with pytest.raises(InputError, match="b01 is lost: meshctl does not manage lost and retired nodes") as caught:
        select_one(team, "b01", read)
    assert caught.value.hint == "if it is back, run `meshctl inventory state b01 deployed`"
    assert select_one(team, "b01", read, with_unmanaged=True).state is NodeState.LOST


def test_the_beginning_of_several_names_suggests_a_pattern_and_not_one_of_them() -> None:
    with pytest.raises(InputError, match="no managed node of lab matches 'b0'") as caught:
        chosen("b0")
    assert caught.value.hint == "2 names begin with it: 'b0*' selects them"


def test_the_values_in_a_hint_are_limited() -> None:
    labels: dict[str, Attributes] = {f"h{number}": {"label": [f"House {number}"]} for number in range(1, 401)}
    with pytest.raises(InputError) as raised:
        select(["label:nothing"], labels, read, what="node")
    assert raised.value.hint.startswith("found: House 1, House 2, ")
    assert raised.value.hint.endswith(", House 12 and 388 more")
