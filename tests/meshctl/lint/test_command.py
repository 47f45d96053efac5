"""`meshctl lint` as a user meets it: arguments, files, exit status."""

import json
from pathlib import Path

import pytest
import yaml

from meshctl.cli.main import main
from meshctl.lint.example import BASE, ENVIRONMENT
from meshctl.lint.pages import page
from meshctl.lint.rules.power import conducted_above_fcc
from meshctl.regdb import SHIPPED

_FAULTY = BASE + "apply: {canary: false, quorum: 0.2}\n"


@pytest.fixture(autouse=True)
def _secrets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("MESHCTL_INVENTORY", raising=False)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    monkeypatch.chdir(tmp_path)


def _lint(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["lint", *arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code


def _file(name: str, text: str) -> str:
    Path(name).write_text(text, encoding="utf-8")
    return name


def test_a_clean_inventory_exits_with_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint(_file("clean.yaml", BASE)) == 0
    assert capsys.readouterr().out == "nothing found in 1 file\n"


def test_findings_exit_with_1_and_show_their_positions(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint(_file("faulty.yaml", _FAULTY)) == 1
    out = capsys.readouterr().out
    assert f"faulty.yaml:{_FAULTY.count(chr(10))}:17: warning: apply.canary" in out
    assert out.endswith("2 warnings in 1 file\n")


def test_a_report_in_a_file_is_summarized_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint(_file("faulty.yaml", _FAULTY), "--format", "sarif", "--out", "lint.sarif") == 1
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("", "2 warnings in 1 file: written to lint.sarif\n")


def test_an_inventory_that_does_not_load_is_a_finding() -> None:
    assert _lint(_file("wrong.yaml", BASE.replace("channel: 6", "channel: six"))) == 1
    assert _lint(_file("broken.yaml", "a: [")) == 1


def test_unreadable_files_and_invalid_options_exit_with_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint("absent.yaml") == 2
    assert "absent.yaml: error: cannot be read" in capsys.readouterr().out
    assert _lint(_file("clean.yaml", BASE), "--regdb", "absent.db") == 2
    assert _lint("clean.yaml", "--select", "MC9999") == 2
    assert _lint("clean.yaml", "--explain", "nonsense") == 2
    assert _lint("clean.yaml", "--baseline", "absent.json") == 2
    assert _lint("clean.yaml", "--write-baseline") == 2
    assert _lint("clean.yaml", "--output", "absent/report.txt") == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert "absent.db: cannot be read" in err


def test_the_default_inventory_is_the_variable_then_the_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    _file("fleet.yaml", BASE)
    assert _lint() == 0
    monkeypatch.setenv("MESHCTL_INVENTORY", _file("other.yaml", _FAULTY))
    assert _lint() == 1


def test_the_inventory_option_works_as_for_other_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint("-i", _file("faulty.yaml", _FAULTY)) == 1
    capsys.readouterr()
    assert _lint("--inventory", "faulty.yaml", _file("clean.yaml", BASE), "--format", "json") == 1
    document = json.loads(capsys.readouterr().out)
    assert document["summary"]["files"] == ["clean.yaml", "faulty.yaml"]


def test_severities_below_the_threshold_do_not_count() -> None:
    note = _file("note.yaml", BASE.replace("    mac: 00:15:6d:00:00:01\n", ""))
    assert _lint(note) == 0
    assert _lint(note, "--fail-on", "note") == 1
    assert _lint(_file("faulty.yaml", _FAULTY), "--fail-on", "error") == 0


def test_rules_are_selected_and_ignored_by_code_prefix(capsys: pytest.CaptureFixture[str]) -> None:
    faulty = _file("faulty.yaml", _FAULTY)
    assert _lint(faulty, "--select", "MC615") == 1
    assert "MC614" not in capsys.readouterr().out
    assert _lint(faulty, "--select", "MC1,MC2") == 0
    assert _lint(faulty, "--ignore", "MC614", "--ignore", "MC615") == 0
    suppressed = _FAULTY.rstrip() + "  # meshctl: ignore MC614, MC615 -- bench\n"
    # a rule that did not run leaves its comments alone
    assert _lint(_file("suppressed.yaml", suppressed), "--select", "MC614,MC002") == 0


def test_the_loaders_codes_are_selected_like_the_rules(capsys: pytest.CaptureFixture[str]) -> None:
    broken = _file("wrong.yaml", BASE.replace("channel: 6", "channel: six").replace("country:", "contry:"))
    assert _lint(broken, "--select", "INV020") == 1
    out = capsys.readouterr().out
    assert "[INV020]" in out
    assert "[INV021]" not in out
    assert _lint(_file("faulty.yaml", _FAULTY), "--select", "INV") == 0
    # the rules did not run on what does not load, so that is said beside them
    wrong = _file("type.yaml", BASE.replace("channel: 6", "channel: six"))
    assert _lint(wrong, "--select", "INV020") == 0
    assert _lint(wrong, "--select", "MC3,INV020") == 1
    assert "[INV021]" in capsys.readouterr().out
    assert _lint(broken, "--select", "MC3") == 1
    assert "[INV021]" in capsys.readouterr().out
    assert _lint(broken, "--ignore", "INV020") == 2
    assert "INV020 cannot be ignored" in capsys.readouterr().err


def test_changed_files_are_checked_with_the_inventories_they_are_part_of(capsys: pytest.CaptureFixture[str]) -> None:
    for folder, text in (("one", _FAULTY), ("two/deep", BASE)):
        Path(folder, "topics").mkdir(parents=True)
        _file(f"{folder}/fleet.yaml", text)
        _file(f"{folder}/topics/all.yaml", "topics: {}")
    _file("workflow.yaml", "on: push")
    files = ["one/topics/all.yaml", "one/fleet.yaml", "two/deep/topics/all.yaml", "workflow.yaml"]
    assert _lint("--files", *files, "--format", "json") == 1
    summary = json.loads(capsys.readouterr().out)["summary"]
    assert (summary["files"], summary["warning"]) == (["one/fleet.yaml", "two/deep/fleet.yaml"], 2)
    assert _lint("--files", "workflow.yaml") == 0
    assert _lint("--files") == 0


def test_the_pre_commit_hook_needs_no_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    (hook,) = yaml.safe_load((Path(__file__).parents[3] / ".pre-commit-hooks.yaml").read_text(encoding="utf-8"))
    program, command, *options = hook["entry"].split()
    assert (program, command, hook.get("pass_filenames", True)) == ("meshctl", "lint", True)
    Path("inventory").mkdir()
    assert _lint(*options, _file("inventory/fleet.yaml", _FAULTY), _file("other.yml", "a: b")) == 1
    assert "2 warnings in 1 file" in capsys.readouterr().out


def test_several_inventories_are_reported_together(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint(_file("faulty.yaml", _FAULTY), _file("clean.yaml", BASE), "faulty.yaml", "--format", "json") == 1
    document = json.loads(capsys.readouterr().out)
    assert document["summary"]["files"] == ["faulty.yaml", "clean.yaml"]
    assert document["summary"]["warning"] == 2


def test_a_baseline_makes_only_new_findings_count(capsys: pytest.CaptureFixture[str]) -> None:
    faulty = _file("faulty.yaml", _FAULTY)
    assert _lint(faulty, "--baseline", "known.json", "--write-baseline") == 0
    assert _lint(faulty, "--baseline", "known.json") == 0
    assert "(2 in the baseline)" in capsys.readouterr().out
    worse = _FAULTY.replace("quorum: 0.2", "quorum: 0.2, stop_after_failures: 9")
    assert _lint(_file("faulty.yaml", worse), "--baseline", "known.json") == 1
    assert "1 warning in 1 file (2 in the baseline)" in capsys.readouterr().out
    assert _lint(_file("faulty.yaml", BASE), "--baseline", "known.json") == 0
    assert capsys.readouterr().out.count("[MC004]") == 2


@pytest.mark.parametrize("form", ["text", "json", "sarif", "junit", "github"])
def test_every_format_goes_to_a_file_as_well(form: str, capsys: pytest.CaptureFixture[str]) -> None:
    faulty = _file("faulty.yaml", _FAULTY)
    assert _lint(faulty, "--format", form) == 1
    printed = capsys.readouterr().out
    assert _lint(faulty, "--format", form, "--output", "report") == 1
    assert Path("report").read_text(encoding="utf-8") == printed
    assert capsys.readouterr().out == ""


def test_explain_prints_the_rules_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint("--explain", "mc342") == 0
    assert capsys.readouterr().out == page(conducted_above_fcc)
    assert _lint("--explain", "INV020") == 0
    assert "INV020" in capsys.readouterr().out


def test_list_names_every_rule(capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint("--list") == 0
    assert "MC342  error    The conducted power exceeds the FCC limit\n" in capsys.readouterr().out


def test_the_rules_of_a_prefix_are_listed_and_named_where_one_was_to_be_explained(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _lint("--list", "--select", "MC34") == 0
    codes = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert "MC342" in codes
    assert all(code.startswith("MC34") for code in codes)
    assert _lint("--explain", "mc34") == 2
    assert "run `meshctl lint --list --select MC34` to list these rules" in capsys.readouterr().err


def test_a_machine_without_a_regulatory_database_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("meshctl.regdb.file.SYSTEM", Path("absent.db"))
    assert _lint(_file("clean.yaml", BASE)) == 0
    assert "using the bundled wireless-regdb " in capsys.readouterr().err
    assert _lint("clean.yaml", "--regdb", str(SHIPPED)) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("words", [["--out"], ["--write-baseline", "--baseline"]])
def test_a_report_does_not_overwrite_the_inventory(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert _lint(_file("fleet.yaml", BASE), *words, "./fleet.yaml") == 2
    assert "is a file of the inventory, and would be overwritten" in capsys.readouterr().err
    assert Path("fleet.yaml").read_text(encoding="utf-8") == BASE
