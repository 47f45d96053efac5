"""A path -> everything there is to report about it: load, run the rules, divide by comments.

The loader's diagnostics are findings like any other. The inventory's text is kept as it was read, for the comments, for
rules about text, and for reports that show the line.
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
from meshctl.inventory.source import read_bytes
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
    """`sources` maps the files that were read to their text. `is_readable` is False when a file could not be read."""

    diagnostics: tuple[Diagnostic, ...]
    suppressed: tuple[Suppressed, ...]
    sources: Mapping[str, str]
    is_readable: bool


def check_path(path: Path, regdb: Regdb, environ: Mapping[str, str], rules: Iterable[Rule] = RULES) -> CheckResult:
    """Everything about the inventory at `path`; secrets are looked at where `environ` has them. Never raises."""
    chosen = tuple(rules)
    kept: dict[str, bytes] = {}

    def read(file: Path) -> bytes:
        kept[str(file)] = content = read_bytes(file)
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
            # not at hand on this machine; rules about files say when one is missing
            return None

    return secret


def _problem(store: SecretStore) -> SecretProblem:
    def problem(ref: SecretRef) -> str:
        try:
            store.get(ref)
        except InputError as error:
            if ref.kind is SecretKind.ENV and ref.where not in store.environ:
                return ""
            if ref.kind is SecretKind.AGE and not _opens(store, ref):
                return ""
            return str(error).removeprefix(f"secret {ref}: ")
        return ""

    return problem


def _opens(store: SecretStore, ref: SecretRef) -> bool:
    """Whether this machine has an identity for the encrypted file."""
    try:
        store.get(replace(ref, key=""))
    except InputError:
        return False
    return True
