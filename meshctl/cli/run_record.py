"""The run that an operator named, by its number or as the last one, checked before it is resumed or rolled back."""

from __future__ import annotations

from collections.abc import Iterable

from meshctl.errors import InputError
from meshctl.fleet.journal import Journal, RunRecord

LAST = "last"
# SQLite's integers have 64 bits
_MAX_DIGITS = 18


def run_number(text: str, latest: Iterable[RunRecord], *, of: str = "") -> int:
    """The number of the run that `text` names; `last` names the first of `latest`, which are those ` of` a selection.
    Raises InputError for other text."""
    if text == LAST:
        newest = next(iter(latest), None)
        if newest is None:
            raise InputError(f"there is no run{of or ' yet'}", hint="run `meshctl history` to list all runs")
        return newest.id
    if not (text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS):
        raise InputError(
            f"expected the number of a run, or `{LAST}`, found {text}", hint="`meshctl history` lists all runs"
        )
    return int(text)


def run_of(journal: Journal, fleet: str, number: int) -> RunRecord:
    """A run of this fleet that has ended. Raises InputError if there is none, or if it is still in progress.

    A lab's fleet has the same name as the real one, but its runs are not the real fleet's.
    """
    record = journal.run(number)
    if record is None:
        raise InputError(f"run {number} does not exist", hint="run `meshctl history` to list all runs")
    if record.fleet != fleet:
        hint = f"`meshctl history --fleet {fleet}` lists the runs of {fleet}"
        raise InputError(f"run {number} belongs to fleet {record.fleet}, not to {fleet}", hint=hint)
    if record.lab and record.lab != journal.lab:
        raise InputError(f"run {number} belongs to the lab in {record.lab}", hint=f"add `--lab {record.lab}`")
    if journal.lab and not record.lab:
        raise InputError(
            f"run {number} belongs to the real fleet, but $MESHCTL_LAB or --lab selects the lab in {journal.lab}",
            hint="unset MESHCTL_LAB, and omit --lab",
        )
    if not record.is_over:
        raise InputError(f"run {number} is still in progress ({record.owner})", hint="wait for it, or interrupt it")
    return record
