"""A baseline holds what was there, and nothing else."""

from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic, Position, Severity
from meshctl.errors import InputError
from meshctl.lint.baseline import compare, dump, fingerprint, read

_FINDING = Diagnostic(
    "MC323", Severity.ERROR, Position("fleet.yaml", 9, 3), "not allowed", "meshes.main.channel", "11", "13"
)
_OTHER = replace(_FINDING, code="MC614", path="apply.canary")
_RAN = ("MC323", "MC614")


def _written(directory: Path, *items: Diagnostic) -> Path:
    path = directory / "baseline.json"
    path.write_text(dump(items), encoding="utf-8")
    return path


def test_a_baseline_finding_is_recognized_on_another_line(tmp_path: Path) -> None:
    path = _written(tmp_path, _FINDING)
    moved = replace(_FINDING, position=Position("elsewhere/fleet.yaml", 90, 1), message="said in other words")
    compared = compare([moved, _OTHER], read(path), path, _RAN)
    assert compared.known == (moved,)
    assert compared.new == (_OTHER,)
    assert compared.stale == ()


def test_a_different_value_or_path_is_a_different_finding() -> None:
    assert fingerprint(replace(_FINDING, found="14")) != fingerprint(_FINDING)
    assert fingerprint(replace(_FINDING, path="meshes.b.channel")) != fingerprint(_FINDING)


def test_two_identical_findings_need_two_entries(tmp_path: Path) -> None:
    path = _written(tmp_path, _FINDING)
    assert compare([_FINDING, _FINDING], read(path), path, _RAN).new == (_FINDING,)
    path = _written(tmp_path, _FINDING, _FINDING)
    assert compare([_FINDING, _FINDING], read(path), path, _RAN).new == ()


def test_stale_entries_are_reported_unless_their_rule_did_not_run(tmp_path: Path) -> None:
    path = _written(tmp_path, _FINDING, _OTHER)
    (stale,) = compare([_OTHER], read(path), path, _RAN).stale
    assert (stale.code, stale.found, stale.position.file) == ("MC004", "meshes.main.channel", str(path))
    assert compare([_OTHER], read(path), path, ("MC614",)).stale == ()


def test_the_baseline_does_not_depend_on_the_order_of_findings() -> None:
    assert dump([_FINDING, _OTHER]) == dump([_OTHER, _FINDING])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a baseline in JSON"),
        ("[" * 100_000, "expected a baseline in JSON"),
        ("[]", "expected a baseline of version 1"),
        ('{"version": 2, "findings": []}', "expected a baseline of version 1"),
        ('{"version": 1, "findings": [7]}', "finding 1: expected fingerprint, code and about"),
    ],
)
def test_an_invalid_baseline_is_rejected_by_file_name(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=f"other.json: .*{message}"):
        read(path)
    with pytest.raises(InputError, match=r"absent\.json: cannot be read"):
        read(tmp_path / "absent.json")
