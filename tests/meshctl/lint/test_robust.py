"""Whatever an inventory says, lint answers with findings."""

import copy
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from meshctl.lint import RULES, Example, check_path
from meshctl.lint.example import ENVIRONMENT, compose, environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_EXAMPLES = [example for rule in RULES[::7] for example in (rule.failing, rule.passing) if "#" not in example.fragment]
_NUMBERS = [0, 1, 14, 36, 173, 196, 60, 40, 0.001, 65535, 99999]
_WORDS = ["", "x", "ü'", "HT40+", "VHT160", "BATMAN_V", "meshmerize", "sae", "mesh", "19.07", "25.12", "lost", "spare"]
_NAMES = [
    "10.42.0.1",
    "10.42.0.1/24",
    "10.42.0.0/31",
    "fd42::1",
    "fd42::1/64",
    "fd42::/64",
    "ff:ff:ff:ff:ff:ff",
    "5g",
    "main",
    "husky1",
    "b01",
    "all",
    "base",
]
_WHOLES: list[Any] = [None, True, [], {}, ["x", "x"], {"x": 1}, {"env": "X"}, {"file": "nope"}, {"age": "nope"}]
_VALUES = st.sampled_from([*_NUMBERS, *_WORDS, *_NAMES, *_WHOLES])


def _document(example: Example) -> dict[str, Any]:
    """Parsed when a test draws it, since every worker of a run imports this module."""
    document: dict[str, Any] = yaml.load(compose(example), Loader=_LOADER)
    return document


def _places(tree: object, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    if path:
        yield path
    pairs = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in pairs:
        yield from _places(value, (*path, key))


@settings(max_examples=40)
@given(
    st.sampled_from(_EXAMPLES).map(_document),
    st.lists(st.tuples(st.integers(0, 10_000), _VALUES), min_size=1, max_size=3),
)
def test_a_mutated_inventory_never_crashes_the_linter(
    tmp_path_factory: pytest.TempPathFactory, document: dict[str, Any], changes: list[tuple[int, Any]]
) -> None:
    changed = copy.deepcopy(document)
    for number, value in changes:
        places = list(_places(changed))
        *way, last = next(itertools.islice(itertools.cycle(places), number, None))
        inside: Any = changed
        for key in way:
            inside = inside[key]
        inside[last] = copy.deepcopy(value)
    path = tmp_path_factory.mktemp("any") / "fleet.yaml"
    path.write_text(yaml.safe_dump(changed), encoding="utf-8")
    for item in check_path(path, _REGDB, ENVIRONMENT).diagnostics:
        assert item.position.file == str(path) or item.code in ("MC901",)
        assert item.position.line >= 1
        assert item.text


_PARTS = """
meshes: {main: {backend: meshmerize, operator_parts:
  {templates: PATH, service: mm, interface: mm0, status_command: mm-status, packages: [mm]}}}
"""


@pytest.mark.parametrize("path", ["~nobody-here/x", "/dev/zero", "/dev/null", ".", "a" * 5000])
@pytest.mark.parametrize(
    "fragment",
    [
        "hardware: {rocket: {firmware: {image: PATH, revision: r1, usign_key: PATH}}}",
        "hardware: {rocket: {package_files: [PATH]}}",
        "udp_mesh: {keys: [{file: PATH}]}",
        "udp_mesh: {keys: [{age: PATH, identity: PATH}]}",
        "nodes: {base: {ssh: {key_files: [PATH]}}}",
        _PARTS,
    ],
)
def test_an_unusable_path_gives_at_most_the_expected_findings(fragment: str, path: str, tmp_path: Path) -> None:
    example = Example(fragment.replace("PATH", path))
    codes = {item.code for item in check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics}
    assert codes <= {"MC444", "MC450", "MC452", "MC801", "MC804", "MC808", "MC809", "MC811", "MC901"}
