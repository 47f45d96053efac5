"""Syntax errors of YAML: the line that is named is the one with the mistake, with both of PyYAML's parsers."""

from __future__ import annotations

import pytest
import yaml

from meshctl.inventory import compose as module
from meshctl.inventory.compose import LOADER, compose
from meshctl.inventory.source import Source


@pytest.mark.parametrize("loader", [LOADER, yaml.SafeLoader])
@pytest.mark.parametrize(
    ("text", "line", "column", "message", "hint"),
    [
        ("a:\n  channel:6\n  b: 1\n", 2, 3, "neither `key: value`", "a space after the colon"),
        ("a:\n  x: 1\n  channel:6\n  b: 1\n", 3, 3, "neither `key: value`", "a space after the colon"),
        ("a:\n  x: 1\n  htmode HT20\n  b: 1\n", 3, 3, "neither `key: value`", "with a colon and a space"),
        ("a:\n  x: 1\n  channel = 6\n  b: 1\n", 3, 3, "neither `key: value`", "not `=`"),
        ("a:\n  - x\n  -y\n", 3, 3, "neither `key: value`", "a space after the hyphen"),
        ("operators\n  ssh_keys: []\n", 1, 1, "neither `key: value`", "with a colon and a space"),
        ('a: "24.10\nb: 2\nc: ["x[1]"]\n', 1, 4, "a quote that is not closed", "close it"),
        ("a: 'x\nb: 1\n", 1, 4, "a quote that is not closed", "close it"),
        ("a: [b, c\nd: e\n", 1, 4, "`[` is not closed", "`]`"),
        ("a: {b: 1, c\n\n# remark\nd: e\n", 1, 4, "`{` is not closed", "`}`"),
        ("a:\n  - {b: 1\n", 2, 5, "`{` is not closed", "`}`"),
        ("a: [x, y]]\nb: 1\n", 1, 10, "", "remove the `]`"),
        # an entry that is indented less than its neighbors, and one that is indented more
        ("n:\nbase: {a: 1}\n  mule: 2\n  x: 1\n", 2, 1, "line 3 is indented by 2 spaces, line 2 by 0", "alike"),
        ("m:\n  k:\n    s: 1\n  c: 6\n    h: 1\n", 4, 3, "line 5 is indented by 4 spaces, line 4 by 2", "alike"),
        ("a:\n  m: 1\n    c: 2\n  q: 1\n", 3, 5, "line 3 is indented by 4 spaces, line 2 by 2", "alike"),
        ("t:\n    e: 1\n  o: 2\n", 2, 5, "line 3 is indented by 2 spaces, line 2 by 4", "alike"),
        ("h:\n   d:\n     x: 1\n  p:\n    x: 1\n", 2, 4, "line 4 is indented by 2 spaces, line 2 by 3", "alike"),
        ("h:\n  d:\n    x: 1\n  b: 2\n p:\n    x: 1\n", 5, 2, "line 5 is indented by 1 space, line 2 by 2", "alike"),
        ("a:\n  - x\n  b: 1\n", 3, 3, "neither a list item like line 2, nor indented less", ""),
        ("m:\n  a: 1\n<<<<<<< HEAD\n  b: 1\n=======\n  b: 2\n>>>>>>> x\n", 3, 1, "merge conflict", "remove the lines"),
        ("<<<<<<< HEAD\na: 1\n=======\na: 2\n>>>>>>> b\n", 1, 1, "merge conflict", "remove the lines"),
        ("fleet:\u00a0heron\na: 1\n", 1, 7, "U+00A0", "a space in its place"),
        ("a:\n  b: 1\n \u00a0c: 1\n  d: 1\n", 3, 2, "U+00A0", "a space in its place"),
    ],
)
def test_the_line_with_the_mistake_is_named(
    text: str,
    line: int,
    column: int,
    message: str,
    hint: str,
    loader: type[yaml.SafeLoader],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "LOADER", loader)
    (problem,) = compose(Source("t.yaml", text)).diagnostics
    assert (problem.position.line, problem.position.column) == (line, column)
    assert message in problem.message
    assert hint in problem.hint


@pytest.mark.parametrize("loader", [LOADER, yaml.SafeLoader])
def test_every_cut_and_every_pair_of_broken_lines_is_reported_inside_the_file(
    loader: type[yaml.SafeLoader], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LOADER", loader)
    lines = [
        "a:",
        "  - {b: 1, c: [d,",
        "    e]}",
        "  -y",
        "   f: 'x",
        " g:h",
        "\th: >-",
        '  i: "',
        "- j",
        "]",
        "k: }",
        "",
    ]
    broken = 0
    for first in lines:
        for second in lines:
            for third in lines:
                text = "\n".join((first, second, third))
                for problem in compose(Source("t.yaml", text)).diagnostics:
                    broken += 1
                    assert 1 <= problem.position.line <= text.count("\n") + 1
                    assert problem.position.column >= 1
    assert broken > len(lines)
