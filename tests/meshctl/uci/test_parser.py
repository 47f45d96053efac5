"""Where the reader puts its finger, and what it makes of `uci export`."""

from __future__ import annotations

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.uci import Package, Section, parse, parse_export


@pytest.mark.parametrize(
    ("text", "line", "column", "words"),
    [
        ("config t n\n\toption a b c\n", 2, 13, "expected the end of the statement, found 'c'"),
        ("config t n\n\toption a 'b\n\n", 2, 11, "expected a closing ' for this one, found the end of the file"),
        ('\n  bogus "x"\n', 2, 3, "expected package, config, option or list, found 'bogus'"),
        ("option a b\n", 1, 1, "expected a config line before the first option, found none"),
        ("config t n\noption a-b c\n", 2, 8, "expected an option name of letters, digits and _, found 'a-b'"),
        ("config t n\nconfig u n\n", 2, 1, "expected section 'n' to be of type 't' as before, found 'u'"),
        ("config t n\noption a 'b\0'\n", 2, 12, "expected text, found a NUL byte"),
        ("config\n", 1, 1, "expected package, config, option or list, found 'config\\n'"),
        ("config t n\n  option", 2, 9, "expected an argument after option, found the end of the file"),
        ("config '' n\n", 1, 8, "expected a section type, found nothing"),
    ],
)
def test_a_syntax_error_reports_its_line_and_column(text: str, line: int, column: int, words: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        parse(text, "etc/config/x")
    assert str(caught.value) == f"etc/config/x:{line}:{column}: {words} [UCI001]"


def test_the_package_is_named_after_its_file() -> None:
    assert parse("package other\n", "etc/config/network") == Package("network")


def test_an_export_holds_its_packages_in_order() -> None:
    text = "package a\n\nconfig t\n\npackage b\n\nconfig u 'n'\n\toption x '1'\n\n"
    assert parse_export(text, "-") == (
        Package("a", (Section("t"),)),
        Package("b", (Section("u", "n", {"x": "1"}),)),
    )


@pytest.mark.parametrize("text", ["config t\n", "package a\npackage a\n"])
def test_an_export_with_a_missing_or_duplicate_package_line_is_rejected(text: str) -> None:
    with pytest.raises(InvalidInput):
        parse_export(text, "-")


def test_section_keys_match_uci_addressing() -> None:
    tree = parse("config t\nconfig t n\nconfig u\nconfig t\n", "x")
    assert tree.keys() == ("@t[0]", "n", "@u[0]", "@t[2]")
