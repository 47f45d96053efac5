from __future__ import annotations

import pytest

from meshctl.errors import InputError
from meshctl.inventory.selection import Attributes, select

CANDIDATES: dict[str, Attributes] = {
    "base": {"role": ("base",), "group": (), "mesh": ("main",)},
    "b01": {"role": ("beacon",), "group": ("spares",), "mesh": ("main",)},
    "b02": {"role": ("beacon",), "group": ("drops", "west"), "mesh": ("main", "side")},
    "husky1": {"role": ("robot",), "group": ("west",), "mesh": ("side",)},
}
FILES = {"run": "b01  # the first\n\nrole:base,!b02\n", "nested": "@run\n"}


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
def test_words_select(words: tuple[str, ...], names: list[str]) -> None:
    assert chosen(*words) == names


@pytest.mark.parametrize(
    ("words", "message", "hint"),
    [
        (("b1",), "no managed node of lab matches 'b1'", "did you mean 'b01'?"),
        (("wset",), "no managed node of lab matches 'wset'", "did you mean 'west'?"),
        (("rol:beacon",), "'rol:beacon': unknown attribute 'rol'", "did you mean 'role'?"),
        (("role:becon",), "no managed node of lab has role 'becon'", "did you mean 'beacon'?"),
        (("mesh:zz",), "no managed node of lab has mesh 'zz'", "found: main, side"),
        (("b01", "!b0*"), "b01,!b0*: selects no managed node of lab", ""),
        (("!",), "'!': expected a name, a pattern, ATTRIBUTE:VALUE or !TERM", "for example"),
        (("role:",), "'role:': expected a name, a pattern, ATTRIBUTE:VALUE or !TERM", "for example"),
        (("@gone",), "@gone: cannot read the selection: No such file or directory", ""),
        (("@nested",), "nested:1: '@run': expected a name, a pattern, ATTRIBUTE:VALUE or !TERM", "for example"),
    ],
)
def test_a_term_that_selects_nothing_is_an_error(words: tuple[str, ...], message: str, hint: str) -> None:
    with pytest.raises(InputError) as caught:
        chosen(*words)
    assert str(caught.value) == message
    assert hint in (caught.value.hint or "")
