"""Results as JSON lines: one self-describing line per case, the same bytes wherever the case ran. Pure.

    {"scenario": "final-run", "scenario_sha256": "...", "revision": "...", "set": {"air.least_loss": "0.1"}, "seed": 7,
     "figures": {"channel.airtime_share": 0.43, ...}}

A case that failed has `failed` with the reason instead of `figures`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any

from mesh_sweep.cases import Case, order
from mesh_sweep.errors import SweepError

Figures = Mapping[str, float | None]
"""A case's figures by name; None where there is nothing to measure (the latency of messages that never arrived)."""
NOTHING: Figures = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Identity:
    """The header of a results file: the scenario, and the code that simulated it."""

    scenario: str
    scenario_sha256: str
    revision: str

    def __str__(self) -> str:
        return f"scenario {self.scenario} ({self.scenario_sha256}) at revision {self.revision}"

    @property
    def line_start(self) -> bytes:
        """How each line of such a result begins."""
        return json.dumps(asdict(self)).encode()[:-1] + b", "


@dataclass(frozen=True, slots=True)
class Result:
    """A case with its figures, or the reason for having none."""

    case: Case
    figures: Figures = field(default_factory=lambda: NOTHING)
    failed: str = ""


@dataclass(frozen=True, slots=True)
class StoredResults:
    """A file's content. `size` is the length of its complete lines; what follows is a torn line of ours."""

    identity: Identity
    results: tuple[Result, ...]
    size: int


def encode(identity: Identity, result: Result) -> bytes:
    """The result's line, with its newline."""
    ending = {"failed": result.failed} if result.failed else {"figures": dict(sorted(result.figures.items()))}
    rest = {"set": dict(result.case.settings), "seed": result.case.seed, **ending}
    return identity.line_start + json.dumps(rest, allow_nan=False).encode()[1:] + b"\n"


def encode_all(identity: Identity, results: Iterable[Result]) -> bytes:
    """The lines of all results, sorted: the same bytes in whatever order the cases ran."""
    return b"".join(encode(identity, result) for result in sorted(results, key=lambda result: order(result.case)))


def decode(raw: bytes, file: str, expected: Identity | None = None) -> StoredResults:
    """The results of a file's bytes; None accepts those of any one scenario and revision.

    A last line without its end is left out if it began as a line of this sweep. Raises SweepError for a line that is no
    result, and for results of another scenario or revision.
    """
    size = raw.rfind(b"\n") + 1
    identity = expected
    found: list[Result] = []
    for number, line in enumerate(raw[:size].splitlines(), 1):
        own, result = _decode_line(line, f"{file}:{number}")
        if identity is None:
            identity = own
        if own != identity:
            raise SweepError(
                f"{file}:{number}: expected results of {identity}, found those of {own}: give another --out for these, "
                "or remove the file"
            )
        found.append(result)
    torn = raw[size:]
    if identity is None:
        raise SweepError(f"{file}: expected results of a sweep, found {'no complete line' if raw else 'an empty file'}")
    if torn and not (torn.startswith(identity.line_start) or identity.line_start.startswith(torn)):
        raise SweepError(
            f"{file}:{len(found) + 1}: expected a result of {identity}, found {_start(torn)}: give another --out"
        )
    return StoredResults(identity, tuple(merge(found, file)), size)


def _start(line: bytes) -> str:
    return repr(line[:40].decode("utf-8", "replace"))


def _decode_line(line: bytes, where: str) -> tuple[Identity, Result]:
    try:
        value = json.loads(line)
        identity = Identity(*(str(value[key]) for key in ("scenario", "scenario_sha256", "revision")))
        settings = tuple(sorted((str(path), str(text)) for path, text in value["set"].items()))
        figures = {str(name): _number(figure) for name, figure in value.get("figures", {}).items()}
        result = Result(Case(settings, int(value["seed"])), figures, str(value.get("failed", "")))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        raise SweepError(
            f"{where}: expected a result of a sweep (one JSON object), found {_start(line)}; if the file is damaged, "
            "remove this line, and its case runs again"
        ) from None
    return identity, result


def _number(value: Any) -> float | None:
    """A whole number stays one, so that its line is the same again. Raises TypeError."""
    if value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    raise TypeError(f"expected a number or null, found {value!r}")


def merge(results: Iterable[Result], file: str) -> list[Result]:
    """One result per case: figures count more than a failure, a later failure more than an earlier one.

    Raises SweepError if a case has different figures: one of the machines computes something else.
    """
    found: dict[Case, Result] = {}
    for result in results:
        known = found.get(result.case)
        if known is None or known.failed:
            found[result.case] = result
        elif not result.failed and result.figures != known.figures:
            raise SweepError(
                f"{file}: expected the same figures from each run of a case, found two results of {result.case}"
            )
    return list(found.values())
