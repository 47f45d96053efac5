"""Reading YAML: both of PyYAML's parsers, and what slips of the pen are answered with."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from meshctl.inventory import compose as module
from meshctl.inventory.compose import compose
from meshctl.inventory.source import Source, read_source
from meshctl.inventory.tree import MappingNode
from tests.meshctl.inventory.inventories import SHIPPED


@pytest.mark.parametrize("name", ["subt-final/fleet.yaml", "subt-final/topics.yaml", "starter/fleet.yaml"])
def test_both_parsers_give_the_same_tree_with_the_same_places(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    source = read_source(SHIPPED / name)
    assert isinstance(source, Source)
    first = compose(source)
    monkeypatch.setattr(module, "LOADER", yaml.SafeLoader)
    assert compose(source) == first
    assert first.diagnostics == ()


@pytest.mark.parametrize("text", ["[" * 50_000, "a: [", "a: *b", "- !x y", "a: @", "{a: 1, a: 2}", "\ufffe", "é: 'ü"])
def test_both_parsers_report_the_same_errors_at_the_same_lines(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first = compose(Source("t.yaml", text))
    monkeypatch.setattr(module, "LOADER", yaml.SafeLoader)
    second = compose(Source("t.yaml", text))
    assert [item.code for item in first.diagnostics] == [item.code for item in second.diagnostics]
    assert [item.position.line for item in first.diagnostics] == [item.position.line for item in second.diagnostics]


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("a: {b[01-03]: {}}\n", "quote a range inside braces"),
        ("a: Hold: reset\n", "quote a value that contains a colon"),
        ("a: @x\n", "quote a value that begins with @"),
        ("a:\n\t- b\n", "indent YAML with spaces"),
    ],
)
def test_common_yaml_mistakes_get_a_hint(text: str, hint: str) -> None:
    (problem,) = compose(Source("t.yaml", text)).diagnostics
    assert hint in problem.hint


def test_offsets_count_characters_not_bytes() -> None:
    text = "ä: 'öü'\nß: [日本, x]\n"
    root = compose(Source("t.yaml", text)).root
    assert isinstance(root, MappingNode)
    value = root.values["ä"]
    assert text[value.start : value.end] == "'öü'"


def test_syntax_errors_name_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("x: [1\n")
    source = read_source(tmp_path / "a.yaml")
    assert isinstance(source, Source)
    assert compose(source).diagnostics[0].position.file == str(tmp_path / "a.yaml")
