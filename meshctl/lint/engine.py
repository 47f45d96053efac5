"""Fleet and text -> findings: run the rules, repeat those of a rendered node for the nodes alike, add positions, merge
findings that nodes share."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import replace

from meshctl.diagnostics import Diagnostic, Position, sorted_diagnostics
from meshctl.lint.catalog import RULES
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, Rule
from meshctl.lint.trial_rendering import kind_of
from meshctl.model import Fleet, MissingOrigin
from meshctl.wording import join_limited


def lint(fleet: Fleet, context: LintContext, rules: Iterable[Rule] = RULES) -> tuple[Diagnostic, ...]:
    """Findings of the fleet rules, sorted by position. Linear in the size of the fleet."""
    found: list[Diagnostic] = []
    reported: set[Position] = set()
    alike = _Alike(fleet)
    # fallback rules run last: they skip positions that other rules report
    for rule in sorted(rules, key=lambda rule: rule.is_fallback):
        if rule.check is None:
            continue
        items = [
            diagnostic(rule, finding, _position(fleet, finding))
            for one in rule.check(fleet, context)
            for finding in (alike.all_of(one) if rule.is_per_kind else (one,))
        ]
        if rule.is_fallback:
            items = [item for item in items if item.position not in reported]
        found.extend(items)
        reported.update(item.position for item in items)
    return sorted_diagnostics(_merged(found))


class _Alike:
    """The nodes of each kind: a finding in the `extra_uci` of one, perhaps at a line of its own in each of them."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._names: dict[Hashable, list[str]] | None = None

    def all_of(self, finding: Finding) -> Iterator[Finding]:
        """The finding, and the same for every node of the same kind."""
        yield finding
        if finding.position is not None or len(finding.path) < 3 or finding.path[2] != "extra_uci":
            return
        if self._names is None:
            self._names = group_by_key((kind_of(node), node.name) for node in self._fleet.managed())
        name = finding.path[1]
        for other in self._names.get(kind_of(self._fleet.nodes[name]), ()) if name in self._fleet.nodes else ():
            if other != name:
                yield replace(finding, path=("nodes", other, *finding.path[2:]))


def lint_texts(sources: Mapping[str, str], rules: Iterable[Rule] = RULES) -> tuple[Diagnostic, ...]:
    """Findings of the text rules, which need no valid fleet."""
    found = (
        diagnostic(rule, finding, finding.position or Position(file))
        for rule in rules
        if rule.check_text is not None
        for file, text in sources.items()
        for finding in rule.check_text(file, text)
    )
    return sorted_diagnostics(found)


def diagnostic(rule: Rule, finding: Finding, position: Position) -> Diagnostic:
    """A finding of `rule` at `position`."""
    return Diagnostic(
        code=rule.code,
        severity=rule.severity,
        position=position,
        message=finding.message,
        path=".".join(finding.path),
        expected=finding.expected,
        found=finding.found,
        hint=finding.hint or rule.fix,
    )


def _position(fleet: Fleet, finding: Finding) -> Position:
    if finding.position is not None:
        return finding.position
    try:
        return fleet.where(*finding.path).position
    except MissingOrigin:
        return Position(fleet.files[0], 1, 1) if fleet.files else Position(fleet.name)


def _merged(found: Iterable[Diagnostic]) -> Iterator[Diagnostic]:
    """Merge findings that differ only in the path (a value that a group or range shares), naming the others."""
    groups: dict[tuple[str, Position, str, str, str], list[Diagnostic]] = {}
    for item in found:
        groups.setdefault((item.code, item.position, item.message, item.expected, item.found), []).append(item)
    for first, *others in groups.values():
        names = list(dict.fromkeys(_subject(item.path) for item in others if item.path != first.path))
        if names:
            also = f"also {join_limited(names)}"
            yield replace(first, message=f"{first.message} ({also})" if first.message else also)
        else:
            yield first


def _subject(path: str) -> str:
    """The subject of a path: `b03` in `nodes.b03.radios.radio0`."""
    parts = path.split(".")
    return parts[1] if len(parts) > 1 else path
