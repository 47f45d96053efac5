"""Any bytes give a fleet or located diagnostics, never an exception."""

from __future__ import annotations

import copy
import json
import tempfile
from pathlib import Path
from typing import Any

import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from meshctl.inventory import Loaded, load
from meshctl.inventory.compose import compose
from meshctl.inventory.source import Source
from tests.meshctl.inventory.inventories import SHIPPED

_EXAMPLE = b"".join(
    (SHIPPED / "subt-final" / name).read_bytes().replace(b"include: [topics.yaml]", b"")
    for name in ("fleet.yaml", "topics.yaml")
)
_LINES = _EXAMPLE.split(b"\n")
# What YAML and the format give a meaning to.
_WORDS = (
    "[ ] { } : , - ? # ' \" | > & * ! % @ ` ~ <<: --- ... \t \n \r &a *a !!str null true 0x10 1e999 .nan b[1-3] "
    "[0-99999] include: \0 \xe9 \u2028 \x85"
)
_TOKENS = [*(word.encode() for word in _WORDS.split(" ")), b"\xff", b" "]


def _load_bytes(content: bytes) -> Loaded:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "fleet.yaml")
        path.write_bytes(content)
        loaded = load(path)
        assert (loaded.fleet is None) == bool(loaded.diagnostics)
        for item in loaded.diagnostics:
            assert item.position.file == str(path)
            assert item.code.startswith("INV")
            assert str(item).isprintable()
        if loaded.fleet is not None:
            assert all(origin.position.line for origin in loaded.fleet.provenance.values())
        return loaded


@given(st.binary(max_size=200))
def test_arbitrary_bytes_load_or_yield_diagnostics(content: bytes) -> None:
    _load_bytes(content)


@given(st.lists(st.sampled_from(_TOKENS), max_size=30), st.sampled_from([b"", b" ", b"\n"]))
def test_arbitrary_yaml_tokens_load_or_yield_diagnostics(tokens: list[bytes], between: bytes) -> None:
    _load_bytes(between.join(tokens))


@given(
    st.lists(
        st.tuples(st.integers(0, len(_EXAMPLE)), st.integers(0, 12), st.sampled_from(_TOKENS)), min_size=1, max_size=4
    )
)
@settings(max_examples=100)
def test_splicing_tokens_into_the_example_loads_or_yields_diagnostics(cuts: list[tuple[int, int, bytes]]) -> None:
    content = _EXAMPLE
    for at, length, token in cuts:
        content = content[:at] + token + content[at + length :]
    _load_bytes(content)


@given(st.lists(st.tuples(st.integers(0, len(_LINES) - 1), st.integers(0, len(_LINES) - 1)), min_size=1, max_size=4))
@settings(max_examples=60)
def test_swapping_lines_of_the_example_loads_or_yields_diagnostics(swaps: list[tuple[int, int]]) -> None:
    lines = list(_LINES)
    for one, other in swaps:
        lines[one], lines[other] = lines[other], lines[one]
    _load_bytes(b"\n".join(lines))


_JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["base", "10.0.0.1"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


def _paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(deeper for key, item in below for deeper in _paths(item, (*path, key)))]


_DOCUMENT = yaml.safe_load(_EXAMPLE)
_PATHS = [path for path in _paths(_DOCUMENT) if path]


@given(st.sampled_from(_PATHS), _JSON)
@settings(max_examples=100)
def test_replacing_any_value_of_the_example_loads_or_yields_diagnostics(path: tuple[Any, ...], value: Any) -> None:
    document = copy.deepcopy(_DOCUMENT)
    place = document
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    _load_bytes(json.dumps(document, ensure_ascii=False).encode("utf-8", errors="replace"))


@given(_JSON)
@settings(max_examples=150)
def test_compose_yields_the_same_structure_as_pyyaml(value: Any) -> None:
    text = yaml.safe_dump(value)
    composed = compose(Source("t.yaml", text))
    if composed.root is None or composed.diagnostics:
        # Keys that are not text and characters beyond the printable are refused here and read there.
        assert composed.diagnostics
        return
    assert _shape(composed.root) == _shape(yaml.compose(text, Loader=yaml.SafeLoader))


def _shape(node: Any) -> Any:
    """Texts with their lines and columns, whichever reader made them."""
    match node:
        case yaml.ScalarNode():
            return node.value, node.start_mark.line + 1, node.start_mark.column + 1
        case yaml.SequenceNode():
            return [_shape(item) for item in node.value]
        case yaml.MappingNode():
            return [(_shape(key), _shape(item)) for key, item in node.value]
    if hasattr(node, "text"):
        return node.text, node.line, node.column
    if hasattr(node, "items"):
        return [_shape(item) for item in node.items]
    return [(_shape(node.keys[key]), _shape(item)) for key, item in node.values.items()]
