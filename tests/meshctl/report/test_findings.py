"""Findings in every format: the same findings, well formed, escaped."""

import json
import re
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.diagnostics import Diagnostic, Position, Severity
from meshctl.lint import Suppressed
from meshctl.report.findings import FORMATS, Findings, formatted
from meshctl.report.findings.annotations import github
from meshctl.report.findings.junit import junit
from meshctl.report.findings.machine import json as as_json
from meshctl.report.findings.plain import text
from meshctl.report.findings.sarif import sarif

_CHANNEL = Diagnostic(
    "MC323",
    Severity.ERROR,
    Position("inventory/fleet.yaml", 2, 20),
    "not allowed",
    "meshes.main.channel",
    "one of 1-11 (country US)",
    "13",
    "Choose a channel that the country allows.",
)
_UNREADABLE = Diagnostic("INV001", Severity.ERROR, Position("absent.yaml"), "cannot be read: No such file")
_NOTE = Diagnostic("MC408", Severity.NOTE, Position("inventory/fleet.yaml", 3, 1), "anyone in reach can join")
_SOURCES = {"inventory/fleet.yaml": "meshes:\n  main: {\tchannel: 13}\nmeshctl: 1\n"}
_FINDINGS = Findings(
    (_CHANNEL, _NOTE),
    _SOURCES,
    excused=(Suppressed(_NOTE, "the radios of the competition stay open"),),
    known=(_CHANNEL,),
    files=("inventory/fleet.yaml",),
)
_NOTHING = Findings((), {"fleet.yaml": "a: 1\n"}, files=("fleet.yaml",))


def test_text_shows_the_line_with_a_caret_the_fix_and_a_summary() -> None:
    assert text(_FINDINGS) == (
        "inventory/fleet.yaml:2:20: error: meshes.main.channel: not allowed: expected one of 1-11 (country US),"
        " found 13 [MC323]\n"
        "  2 |   main: {\tchannel: 13}\n"
        "    |          \t         ^\n"
        "  = Choose a channel that the country allows.\n"
        "inventory/fleet.yaml:3:1: note: anyone in reach can join [MC408]\n"
        "  3 | meshctl: 1\n"
        "    | ^\n"
        "1 error, 1 note in 1 file (1 suppressed, 1 in the baseline)\n"
    )
    assert text(_NOTHING) == "nothing found in 1 file\n"


def test_text_omits_unavailable_and_overlong_source_lines() -> None:
    endless = Findings((_CHANNEL,), {"inventory/fleet.yaml": "a\n" + "x" * 5000})
    assert "xxx" not in text(endless)
    assert text(Findings((_UNREADABLE,))).startswith("absent.yaml: error: cannot be read")


def test_text_contains_no_terminal_escapes() -> None:
    bad = Diagnostic("MC111", Severity.ERROR, Position("f.yaml", 1, 1), "", "nodes.b", "", "\x1b[2J\r")
    assert "\x1b" not in text(Findings((bad,), {"f.yaml": "\x1b[31mred"}))


def test_json_contains_every_field_of_a_finding_and_the_summary() -> None:
    document = json.loads(as_json(_FINDINGS))
    assert document["version"] == 1
    first = document["findings"][0]
    assert (first["code"], first["severity"], first["line"], first["column"]) == ("MC323", "error", 2, 20)
    assert (first["path"], first["expected"], first["found"]) == (
        "meshes.main.channel",
        "one of 1-11 (country US)",
        "13",
    )
    assert re.fullmatch("[0-9a-f]{32}", first["fingerprint"])
    assert document["suppressed"][0]["reason"] == "the radios of the competition stay open"
    assert document["summary"] == {
        "error": 1,
        "warning": 0,
        "note": 1,
        "suppressed": 1,
        "baseline": 1,
        "files": ["inventory/fleet.yaml"],
    }


def _check_sarif(log: dict[str, Any]) -> None:
    """What the schema of SARIF 2.1.0 requires of the objects used here."""
    assert log["version"] == "2.1.0"
    assert log["$schema"].startswith("https://")
    for run in log["runs"]:
        driver = run["tool"]["driver"]
        assert driver["name"]
        rules = driver["rules"]
        assert len({rule["id"] for rule in rules}) == len(rules)
        for rule in rules:
            assert rule["shortDescription"]["text"]
            assert rule["defaultConfiguration"]["level"] in ("none", "note", "warning", "error")
        assert run["columnKind"] in ("utf16CodeUnits", "unicodeCodePoints")
        for result in run["results"]:
            assert result["message"]["text"]
            assert result["level"] in ("none", "note", "warning", "error")
            assert rules[result["ruleIndex"]]["id"] == result["ruleId"]
            assert result.get("baselineState", "new") in ("new", "unchanged", "updated", "absent")
            assert all(isinstance(value, str) for value in result["partialFingerprints"].values())
            for suppression in result.get("suppressions", []):
                assert suppression["kind"] in ("inSource", "external")
            for location in result["locations"]:
                physical = location["physicalLocation"]
                assert re.fullmatch(r"[A-Za-z0-9\-._~:/?#@!$&'()*+,;=%]+", physical["artifactLocation"]["uri"])
                region = physical.get("region", {"startLine": 1})
                assert region["startLine"] >= 1
                assert region.get("startColumn", 1) >= 1


def test_sarif_has_the_required_structure_and_all_findings() -> None:
    log = json.loads(sarif(_FINDINGS))
    _check_sarif(log)
    (run,) = log["runs"]
    assert [result["ruleId"] for result in run["results"]] == ["MC323", "MC408", "MC408", "MC323"]
    assert run["results"][0]["locations"][0]["physicalLocation"] == {
        "artifactLocation": {"uri": "inventory/fleet.yaml", "uriBaseId": "%SRCROOT%"},
        "region": {"startLine": 2, "startColumn": 20},
    }
    assert run["results"][2]["suppressions"][0]["justification"] == "the radios of the competition stay open"
    assert [result["baselineState"] for result in run["results"]] == ["new", "new", "new", "unchanged"]
    _check_sarif(json.loads(sarif(_NOTHING)))
    _check_sarif(json.loads(sarif(Findings((_UNREADABLE,)))))


def test_sarif_file_uris_are_relative_to_the_working_directory_or_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def uri(file: str) -> str:
        item = Diagnostic("MC323", Severity.ERROR, Position(file, 1, 1), "x")
        result = json.loads(sarif(Findings((item,))))["runs"][0]["results"][0]
        return str(result["locations"][0]["physicalLocation"]["artifactLocation"]["uri"])

    assert uri(str(tmp_path / "a b" / "ü.yaml")) == "a%20b/%C3%BC.yaml"
    assert uri("/elsewhere/f.yaml") == "file:///elsewhere/f.yaml"


def test_junit_counts_errors_and_warnings_as_failures() -> None:
    root = ElementTree.fromstring(junit(_FINDINGS).encode())
    (suite,) = root
    assert (suite.get("name"), suite.get("tests"), suite.get("failures")) == ("inventory/fleet.yaml", "2", "1")
    failed, noted = suite.iter("testcase")
    failure = failed.find("failure")
    assert failure is not None
    assert failure.get("type") == "error"
    assert "expected one of 1-11" in (failure.text or "")
    assert "inventory/fleet.yaml:2" in failed.get("name", "")
    assert noted.find("failure") is None
    assert _NOTE.code in (suite.findtext("system-out") or "")


# by the strict schema, JUnit.xsd of Apache Ant: an element's attributes, and its children in their order
_STRICT = {
    "testsuites": (set(), ["testsuite"]),
    "testsuite": (
        {"name", "package", "id", "timestamp", "hostname", "tests", "failures", "errors", "time"},
        ["properties", "testcase", "system-out", "system-err"],
    ),
    "properties": (set(), []),
    "testcase": ({"name", "classname", "time"}, ["failure"]),
    "failure": ({"type", "message"}, []),
    "system-out": (set(), []),
    "system-err": (set(), []),
}


@pytest.mark.parametrize("findings", [_FINDINGS, _NOTHING, Findings((_NOTE,))])
def test_junit_is_valid_under_the_strict_schema(findings: Findings) -> None:
    root = ElementTree.fromstring(junit(findings, datetime(2026, 1, 2, 3, 4, 5)).encode())
    assert root.tag == "testsuites"
    for element in root.iter():
        attributes, children = _STRICT[element.tag]
        assert set(element.attrib) == attributes
        ranks = [children.index(child.tag) for child in element]
        assert ranks == sorted(ranks)
    for number, suite in enumerate(root):
        assert (suite.get("id"), suite.get("timestamp")) == (str(number), "2026-01-02T03:04:05")
        assert [child.tag for child in suite if child.tag != "testcase"] == ["properties", "system-out", "system-err"]


def test_junit_uses_source_date_epoch_as_timestamp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert 'timestamp="1970-01-02T00:00:00"' in junit(_NOTHING)


@pytest.mark.parametrize("moment", ["", "soon", "9" * 20, "-1e9"])
def test_junit_ignores_an_unusable_source_date_epoch(moment: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", moment)
    assert 'timestamp="20' in junit(_NOTHING)


def test_junit_has_a_passed_case_for_a_clean_file() -> None:
    root = ElementTree.fromstring(junit(_NOTHING).encode())
    (case,) = root.iter("testcase")
    assert (case.get("classname"), len(case)) == ("fleet.yaml", 0)


def test_github_output_escapes_workflow_commands() -> None:
    bad = Diagnostic("MC111", Severity.WARNING, Position("a,b:c%.yaml", 1, 2), "50 %\n::stop-commands::x", hint="so")
    assert github(Findings((bad,))) == (
        "::warning file=a%2Cb%3Ac%25.yaml,line=1,col=2,title=meshctl MC111::50 %25%0A::stop-commands::x%0Aso\n"
    )
    assert github(_NOTHING) == ""
    assert github(Findings((_NOTE,))).startswith("::notice file=")


_WORDS = st.text(max_size=30)


@given(_WORDS, _WORDS, _WORDS, st.integers(0, 5), st.integers(0, 200))
def test_no_text_breaks_any_format(message: str, found: str, file: str, line: int, column: int) -> None:
    item = Diagnostic("MC111", Severity.ERROR, Position(file or "f", line, column), message, "nodes.b", "x", found)
    findings = Findings((item,), {item.position.file: found}, files=(item.position.file,))
    assert text(findings).count("[MC111]") >= 1
    assert json.loads(as_json(findings))["findings"][0]["found"] == found
    _check_sarif(json.loads(sarif(findings)))
    ElementTree.fromstring(junit(findings).encode("utf-8"))
    assert github(findings).count("\n") == 1


def test_the_formats_are_named_as_on_the_command_line() -> None:
    assert list(FORMATS) == ["text", "json", "sarif", "junit", "github"]
    assert [formatted(_NOTHING, name) for name in FORMATS] == [
        text(_NOTHING),
        as_json(_NOTHING),
        sarif(_NOTHING),
        junit(_NOTHING),
        github(_NOTHING),
    ]
