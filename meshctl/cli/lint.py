"""`meshctl lint`: check inventories and report findings."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.output import echo, echo_json, terminal_width, write_file
from meshctl.diagnostics import Severity, sorted_diagnostics
from meshctl.errors import ExitCode, InputError
from meshctl.inventory.codes import MEANINGS
from meshctl.lint import BY_CODE, RULES, CheckResult, Rule, check_path
from meshctl.lint import baseline as baselines
from meshctl.lint.pages import page
from meshctl.regdb import SHIPPED, load, shipped_version
from meshctl.report.findings import Findings, formatted, summary
from meshctl.wording import counted


class LintFormat(StrEnum):
    """Output format of findings."""

    TEXT = "text"
    JSON = "json"
    SARIF = "sarif"
    JUNIT = "junit"
    GITHUB = "github"


class Threshold(StrEnum):
    """The lowest severity that makes the exit code 1."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


def lint(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(help="Inventories: YAML files or directories; default: $MESHCTL_INVENTORY or '.'."),
    ] = None,
    inventory: Annotated[list[Path] | None, typer.Option("--inventory", "-i", help="Same as an argument.")] = None,
    files: Annotated[
        bool,
        typer.Option("--files", help="Check the inventories that contain the given files; skip other files."),
    ] = False,
    format: Annotated[LintFormat, typer.Option("--format", "-f", help="Output format.")] = LintFormat.TEXT,
    output: Annotated[Path | None, typer.Option("--out", "--output", "-o", help="Write to this file.")] = None,
    select: Annotated[
        list[str] | None, typer.Option(help="Code prefixes to report: MC3, INV020, or MC342,MC343.")
    ] = None,
    ignore: Annotated[list[str] | None, typer.Option(help="Code prefixes to ignore.")] = None,
    fail_on: Annotated[Threshold, typer.Option(help="Lowest severity that makes the exit code 1.")] = Threshold.WARNING,
    baseline: Annotated[Path | None, typer.Option(help="Ignore the findings in this file.")] = None,
    write_baseline: Annotated[
        bool, typer.Option("--write-baseline", help="Write the current findings to the baseline file.")
    ] = False,
    regdb: Annotated[
        Path | None, typer.Option(help="Regulatory database; default: the system's, else the bundled one.")
    ] = None,
    explain: Annotated[str | None, typer.Option(help="Explain a rule.", metavar="CODE")] = None,
    list_rules: Annotated[bool, typer.Option("--list", help="List all rules, or those of --select.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Same as --format json.")] = False,
) -> None:
    """Check inventories for errors and risks, from the radio up to the application.

    Exit code: 0 no findings, 1 findings, 2 could not run. Notes count only with --fail-on note.

    Example: meshctl lint inventory/ --format sarif --out lint.sarif
    """
    if explain is not None:
        echo(_rule_page(explain), nl=False)
        return
    if list_rules:
        for rule in selected_rules(select or (), ignore or ()):
            echo(f"{rule.code}  {rule.severity.value:<7}  {rule.title}")
        return
    if write_baseline and baseline is None:
        raise InputError("--write-baseline requires --baseline FILE")
    rules = selected_rules(select or (), ignore or ())
    database = load(regdb)
    if regdb is None and database.source == str(SHIPPED):
        echo(f"note: no regulatory database on this machine; using the bundled {shipped_version()}", err=True)
    given = (*(paths or ()), *(inventory or ()))
    targets = given or (Path(os.environ.get("MESHCTL_INVENTORY") or "."),)
    if files:
        targets = tuple(inventories_of(given))
    examined = [check_path(path, database, os.environ, rules) for path in targets]
    findings = merge_results(examined)
    if select:
        findings = _selected(findings, _prefixes(select, (*BY_CODE, *MEANINGS)))
    if write_baseline and baseline is not None:
        known = baselines.dump(item for item in findings.diagnostics if item.code in BY_CODE)
        write_file(baseline, known, inventory=findings.sources)
        echo(f"wrote {counted(len(findings.diagnostics), 'finding')} to {baseline}", err=True)
        return
    if baseline is not None:
        findings = _without_known(findings, baseline, rules)
    width = None if output is not None else terminal_width(sys.stdout)
    report = formatted(findings, "json" if json else format.value, width)
    if output is not None:
        write_file(output, report, inventory=findings.sources)
        echo(f"{summary(findings)}: written to {output}", err=True)
    else:
        # JSON and SARIF are escaped, which keeps their values; other formats are sanitized
        is_json = json or format in (LintFormat.JSON, LintFormat.SARIF)
        (echo_json if is_json else echo)(report, nl=False)
    if not all(item.is_readable for item in examined):
        raise typer.Exit(int(ExitCode.COULD_NOT_RUN))
    least = Severity(fail_on.value).rank
    if any(item.severity.rank <= least for item in findings.diagnostics):
        raise typer.Exit(int(ExitCode.FINDINGS))


def inventories_of(files: Iterable[Path]) -> Iterator[Path]:
    """The inventories that contain the files, each once: the nearest parent directory with a fleet.yaml."""
    found: dict[Path, Path] = {}
    for file in files:
        above = (file, *file.parents) if file.is_dir() else tuple(file.parents)
        holding = next((directory for directory in above if (directory / "fleet.yaml").is_file()), None)
        if holding is not None:
            found.setdefault(holding.resolve(), holding)
    yield from found.values()


def selected_rules(select: Iterable[str], ignore: Iterable[str]) -> tuple[Rule, ...]:
    """The rules with a selected prefix (default: all) and no ignored one.

    Prefixes may be joined by commas. Raises InputError for an unknown prefix.
    """
    wanted, unwanted = _prefixes(select, (*BY_CODE, *MEANINGS)), _prefixes(ignore, BY_CODE)
    return tuple(
        rule
        for rule in RULES
        if (not wanted or rule.code.startswith(wanted)) and not (unwanted and rule.code.startswith(unwanted))
    )


def _prefixes(given: Iterable[str], codes: Iterable[str]) -> tuple[str, ...]:
    prefixes = tuple(part.strip().upper() for text in given for part in text.split(",") if part.strip())
    known = tuple(codes)
    for prefix in prefixes:
        if not any(code.startswith(prefix) for code in known):
            if any(code.startswith(prefix) for code in MEANINGS):
                raise InputError(f"{prefix} cannot be ignored: an inventory with such an error does not load")
            raise InputError(f"no rule code starts with {prefix}", hint="run `meshctl lint --list` to list all rules")
    return prefixes


def _selected(findings: Findings, prefixes: tuple[str, ...]) -> Findings:
    """Drop other findings of the loader if only loader codes are selected. With rules selected they stay: what does not
    load was not checked."""
    if any(code.startswith(prefixes) for code in BY_CODE):
        return findings
    kept = tuple(item for item in findings.diagnostics if item.code.startswith(prefixes))
    return replace(findings, diagnostics=kept)


def merge_results(examined: Iterable[CheckResult]) -> Findings:
    """Merge the findings of several inventories; a file included by two of them is reported once."""
    parts = list(examined)
    sources = {file: text for part in parts for file, text in part.sources.items()}
    diagnostics = dict.fromkeys(item for part in parts for item in part.diagnostics)
    excused = dict.fromkeys(item for part in parts for item in part.suppressed)
    return Findings(sorted_diagnostics(diagnostics), sources, tuple(excused), files=tuple(sources))


def _without_known(findings: Findings, path: Path, rules: Iterable[Rule]) -> Findings:
    entries = baselines.read(path)
    compared = baselines.compare(findings.diagnostics, entries, path, (rule.code for rule in rules))
    reported = sorted_diagnostics((*compared.new, *compared.stale))
    return Findings(reported, findings.sources, findings.excused, compared.known, findings.files)


def _rule_page(code: str) -> str:
    wanted = code.strip().upper()
    if wanted in MEANINGS:
        return f"# {wanted}\n\n{MEANINGS[wanted]}\n"
    rule = BY_CODE.get(wanted)
    if rule is None:
        beginning = wanted and any(known.startswith(wanted) for known in BY_CODE)
        rules = f"`meshctl lint --list{f' --select {wanted}' if beginning else ''}`"
        raise InputError(
            f"unknown rule code {code}: expected a code such as MC342",
            hint=f"run {rules} to list {'these' if beginning else 'all'} rules",
        )
    return page(rule)
