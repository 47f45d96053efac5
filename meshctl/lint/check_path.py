"""A path -> its findings: load, run the rules, apply suppressions.

The loader's diagnostics are findings, too. The text is kept for suppressions, text rules and excerpts in reports.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from meshctl.diagnostics import Diagnostic, sorted_diagnostics
from meshctl.errors import InputError
from meshctl.inventory import load
from meshctl.inventory.codes import UNREADABLE
from meshctl.inventory.secrets import SecretStore
from meshctl.inventory.source import MAX_FILE_BYTES, read_bytes
from meshctl.lint.catalog import BY_CODE, RULES
from meshctl.lint.context import LintContext, SecretLookup, SecretProblem
from meshctl.lint.engine import lint, lint_texts
from meshctl.lint.files import DiskFiles
from meshctl.lint.rule import Rule
from meshctl.lint.suppress import Suppressed, apply
from meshctl.model import Secret, SecretKind, SecretRef
from meshctl.regdb import Regdb


@dataclass(frozen=True, slots=True)
class CheckResult:
    """`sources` maps each file read to its text. `is_readable` is False if a file could not be read."""

    diagnostics: tuple[Diagnostic, ...]
    suppressed: tuple[Suppressed, ...]
    sources: Mapping[str, str]
    is_readable: bool


def check_path(path: Path, regdb: Regdb, environ: Mapping[str, str], rules: Iterable[Rule] = RULES) -> CheckResult:
    """Check the inventory at `path`, and its secrets as far as `environ` makes them available. Never raises."""
    chosen = tuple(rules)
    kept: dict[str, bytes] = {}

    def read(file: Path) -> bytes:
        content = read_bytes(file)
        # no rule reads a file that the loader rejects for its size
        if len(content) <= MAX_FILE_BYTES:
            kept[str(file)] = content
        return content

    loaded = load(path, environ=environ, read=read)
    sources = {file: content.decode("utf-8", errors="replace") for file, content in kept.items()}
    found = [*loaded.diagnostics, *lint_texts(sources, chosen)]
    ran: set[str] = {rule.code for rule in chosen if rule.check_text is not None}
    if loaded.fleet is not None:
        store = SecretStore(environ, Path(loaded.fleet.base))
        context = LintContext(regdb, DiskFiles(), _lookup(store), _problem(store))
        found.extend(lint(loaded.fleet, context, chosen))
        ran = {rule.code for rule in chosen}
    divided = apply(sorted_diagnostics(found), sources, BY_CODE, ran)
    wanted = {rule.code for rule in chosen}
    stay = tuple(item for item in divided.reported if item.code in wanted or item.code not in BY_CODE)
    is_readable = not any(item.code == UNREADABLE for item in loaded.diagnostics)
    return CheckResult(stay, divided.suppressed, sources, is_readable)


def _lookup(store: SecretStore) -> SecretLookup:
    def secret(ref: SecretRef) -> Secret | None:
        try:
            return store.get(ref)
        except InputError:
            # not available on this machine; MC450 to MC452 report what is missing
            return None

    return secret


def _problem(store: SecretStore) -> SecretProblem:
    def problem(ref: SecretRef) -> str:
        try:
            store.get(ref)
        except InputError as error:
            if ref.kind is SecretKind.ENV and ref.where not in store.environ:
                return ""
            if ref.kind is SecretKind.AGE and not _can_decrypt(store, ref):
                return ""
            return str(error).removeprefix(f"secret {ref}: ")
        return ""

    return problem


def _can_decrypt(store: SecretStore, ref: SecretRef) -> bool:
    """Whether this machine can decrypt the file."""
    try:
        store.get(replace(ref, key=""))
    except InputError:
        return False
    return True
