"""Comments excuse what they name, where they stand, with a reason; and are findings themselves otherwise."""

from pathlib import Path

import pytest

from meshctl.lint import check_path
from meshctl.lint.example import BASE, ENVIRONMENT
from meshctl.lint.suppress import find
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)


def _lint(tail: str, directory: Path) -> tuple[list[str], list[str]]:
    """The codes that stay and those that are excused."""
    path = directory / "fleet.yaml"
    path.write_text(BASE + tail, encoding="utf-8")
    examined = check_path(path, _REGDB, ENVIRONMENT)
    return [item.code for item in examined.diagnostics], [item.diagnostic.code for item in examined.suppressed]


def test_a_comment_on_the_line_suppresses_the_finding(tmp_path: Path) -> None:
    assert _lint("apply: {canary: false}  # meshctl: ignore MC614 -- bench\n", tmp_path) == ([], ["MC614"])


def test_a_standalone_comment_applies_to_the_next_line_with_content(tmp_path: Path) -> None:
    tail = "# meshctl: ignore MC614 -- bench\n\n# another comment\napply: {canary: false}\n"
    assert _lint(tail, tmp_path) == ([], ["MC614"])


def test_one_comment_may_name_several_codes(tmp_path: Path) -> None:
    tail = "apply: {canary: false, quorum: 0.2}  # meshctl: ignore MC614, MC615 -- bench\n"
    assert _lint(tail, tmp_path) == ([], ["MC614", "MC615"])


def test_a_comment_suppresses_only_its_code_on_its_line(tmp_path: Path) -> None:
    tail = "apply:\n  canary: false\n  quorum: 0.2  # meshctl: ignore MC615 -- bench\n"
    assert _lint(tail, tmp_path) == (["MC614"], ["MC615"])


def test_a_comment_without_a_reason_suppresses_nothing(tmp_path: Path) -> None:
    assert _lint("apply: {canary: false}  # meshctl: ignore MC614\n", tmp_path) == (["MC614", "MC001"], [])
    assert _lint("apply: {canary: false}  # meshctl: ignore MC614 --  \n", tmp_path) == (["MC614", "MC001"], [])


@pytest.mark.parametrize(
    ("comment", "code"),
    [
        ("ignore MC614 -- why", "MC002"),
        ("ignore MC61 -- why", "MC003"),
        ("ignore INV020 -- why", "MC003"),
        ("ignore -- why", "MC003"),
        ("ignore everything -- why", "MC003"),
    ],
)
def test_a_comment_without_effect_is_a_finding(comment: str, code: str, tmp_path: Path) -> None:
    assert _lint(f"apply: {{canary: true}}  # meshctl: {comment}\n", tmp_path) == ([code], [])


def test_loader_findings_cannot_be_suppressed(tmp_path: Path) -> None:
    stay, excused = _lint("aply: {canary: false}  # meshctl: ignore INV020 -- why\n", tmp_path)
    assert "INV020" in stay
    assert excused == []


def test_a_comment_inside_a_string_is_ignored() -> None:
    text = (
        'a: "x # meshctl: ignore MC614 -- no"\n'
        "b: |\n"
        "  # meshctl: ignore MC614 -- no\n"
        "c: 1 # meshctl: ignore MC615 -- yes\n"
    )
    (found,) = find("f.yaml", text)
    assert (found.line, found.codes, found.reason) == (4, ("MC615",), "yes")
    assert (found.position.line, found.position.column) == (4, 6)


def test_comments_in_invalid_yaml_are_read_up_to_the_error() -> None:
    (found,) = find("f.yaml", "a: [1  # meshctl: ignore MC614 -- yes\n}: {")
    assert found.codes == ("MC614",)
