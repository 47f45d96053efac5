"""Cases as values: what `--set` and `--seeds` ask for -> every combination of settings and seeds.

`--set air.least_loss=0,0.1,0.2 --set channel.attempts=4,8 --seeds 1000` are 6,000 cases.
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from mesh_sweep.errors import SweepError

MAX_CASES = 1_000_000
"""More are a mistake: at a second each they take eleven days of a core."""
MAX_SEED = 1_000_000_000

Settings = tuple[tuple[str, str], ...]
"""(path into the scenario, value as YAML), sorted by path."""

_SIMILAR = 0.8
"""`los` is as similar to `loss`."""
_RANGE = re.compile(r"(\d{1,10})(?:-(\d{1,10}))?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One `--set`: a path into the scenario and the values that it takes."""

    path: str
    values: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Case:
    """One run of the scenario. Two cases with the same values are the same run."""

    settings: Settings
    seed: int

    def __str__(self) -> str:
        return f"{settings_text(self.settings)}, seed {self.seed}"


def settings_text(settings: Settings) -> str:
    """`air.least_loss=0.1 channel.attempts=4`"""
    return " ".join(f"{path}={value}" for path, value in settings) or "as in the file"


def parse_parameters(words: Iterable[str], short: Mapping[str, str]) -> tuple[Parameter, ...]:
    """The parameters of `--set` options, sorted by path; `short` gives the paths of short names.

    Commas separate values, except inside brackets, braces and quotes. Raises SweepError with every problem.
    """
    problems: list[str] = []
    found: dict[str, Parameter] = {}
    for word in words:
        path, equals, text = word.partition("=")
        path = short.get(path.strip(), path.strip())
        values = _split(text)
        if not equals or not path:
            problems.append(f"--set {word}: expected PATH=VALUE[,VALUE...], found no {'path' if equals else '='}")
        elif "" in values:
            problems.append(f"--set {word}: expected a value before and after each comma, found nothing")
        elif len(set(values)) != len(values):
            twice = next(value for value in values if values.count(value) > 1)
            problems.append(f"--set {word}: expected each value once, found {twice!r} twice")
        elif "." not in path and (near := difflib.get_close_matches(path, short, n=1, cutoff=_SIMILAR)):
            # no file has such a key at its top, and one that is there would be suggested otherwise
            problems.append(f"--set {word}: expected a path or a short name, found {path!r}; did you mean {near[0]!r}?")
        elif path == "seed":
            problems.append(f"--set {word}: expected no seeds here; use --seeds")
        elif path in found:
            problems.append(f"--set {word}: expected each path once, found {path} in two options")
        else:
            found[path] = Parameter(path, tuple(values))
    if problems:
        raise SweepError("\n".join(problems))
    return tuple(found[path] for path in sorted(found))


def _split(text: str) -> list[str]:
    values, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        elif letter == "," and depth <= 0:
            values.append("")
            continue
        values[-1] += letter
    return [value.strip() for value in values]


def parse_seeds(text: str) -> range:
    """`1000` is 1 to 1000, `501-1000` what it says. Raises SweepError."""
    match = _RANGE.fullmatch(text.strip())
    if match is not None:
        first, last = (1, int(match[1])) if match[2] is None else (int(match[1]), int(match[2]))
        if first <= last <= MAX_SEED:
            return range(first, last + 1)
    raise SweepError(f"--seeds: expected a number (1000) or a range (501-1000) up to {MAX_SEED}, found {text!r}")


def combinations(parameters: Sequence[Parameter]) -> list[Settings]:
    """Every combination of the parameters' values. Raises SweepError above MAX_CASES."""
    count = 1
    for parameter in parameters:
        count *= len(parameter.values)
    _check_count(count)
    paths = [parameter.path for parameter in parameters]
    return [
        tuple(zip(paths, values, strict=True))
        for values in itertools.product(*(parameter.values for parameter in parameters))
    ]


def cases_of(settings: Sequence[Settings], seeds: range) -> list[Case]:
    """All cases, seed by seed, so that an interrupted sweep has something of every setting."""
    _check_count(len(settings) * len(seeds))
    return [Case(setting, seed) for seed in seeds for setting in settings]


def _check_count(count: int) -> None:
    if count > MAX_CASES:
        raise SweepError(f"expected at most {MAX_CASES} cases, found {count}: use fewer seeds or values")


def order(case: Case) -> tuple[tuple[tuple[str, bool, float, str], ...], int]:
    """The sort key of results: settings by their values, numbers as numbers, then the seed."""
    return settings_order(case.settings), case.seed


def settings_order(settings: Settings) -> tuple[tuple[str, bool, float, str], ...]:
    return tuple((path, *_value_order(value)) for path, value in settings)


def _value_order(value: str) -> tuple[bool, float, str]:
    try:
        number = float(value)
    except ValueError:
        return True, 0.0, value
    # nan has no order
    return (True, 0.0, value) if number != number else (False, number, value)
