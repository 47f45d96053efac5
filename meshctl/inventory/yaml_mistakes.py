"""A YAML syntax error -> the line with the mistake, what is wrong there, and what to do.

A parser stops where it cannot go on, often a line or more after the mistake: at the line behind a missing colon, or at
the next quote behind one that was left open.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import yaml

from meshctl.diagnostics import Diagnostic, Position
from meshctl.inventory import codes
from meshctl.inventory.source import Source
from meshctl.wording import counted

# the parser stops at the bracket of a name such as b[01-12] in flow style
_RANGE_IN_BRACES = re.compile(r"[{,]\s*[\w.-]+\[$")
# and behind that of a name in a list: [b[01-12]]
_RANGE_IN_LIST = re.compile(r"\[(?:[^\[\]]*,)?\s*[\w.-]+\[[^\[\]]*\]?\]?$|\[(?:[^\[\]]*,)?\s*[\w.-]+\[$")
_MISSING_COMMA = re.compile(r"[{,]\s*[\w.-]+: +[^\s,{}\[\]:]+[ ;]+[\w.-]+:$")
_CONFLICT = re.compile(r"(<{7}|>{7}) ")
# spaces that YAML takes for letters: browsers, PDF files and chats put them in
_ODD_SPACE = re.compile("[\u00a0\u1680\u2000-\u200b\u202f\u205f\u2060\u3000\ufeff]")
_KEY = re.compile(r"(?:- +)*(?:[^\s#'\"\[{].*?|'[^']*'|\"[^\"]*\"):(?:\s|$)")
_LIST_ITEM = re.compile(r"-(\s|$)")
# messages of libyaml and of PyYAML's own parser
_NO_KEY = ("did not find expected key", "did not find expected '-' indicator", "expected <block end>")
_NO_VALUE = "mapping values are not allowed"
_NO_COLON = "could not find expected ':'"
_LATE = (*_NO_KEY, _NO_VALUE, _NO_COLON)


@dataclass(frozen=True, slots=True)
class _Mistake:
    """`line` and `column` count from 0."""

    line: int
    column: int
    text: str
    hint: str


def syntax_error(source: Source, reason: yaml.MarkedYAMLError, quote: yaml.ScalarEvent | None) -> Diagnostic:
    """The diagnostic of a syntax error; `quote` is the last quoted value of several lines before it."""
    lines = source.text.splitlines() or [""]
    found = _mistake(lines, reason, quote) or _as_reported(source, lines, reason)
    place = Position(source.file, found.line + 1, found.column + 1)
    return codes.error(codes.YAML_SYNTAX, place, f"not valid YAML{found.text}", hint=found.hint)


def _as_reported(source: Source, lines: Sequence[str], reason: yaml.MarkedYAMLError) -> _Mistake:
    """Where the parser stopped."""
    context = f" {reason.context}" if reason.context else ""
    text = f"{context}: {reason.problem}"
    mark = reason.problem_mark or reason.context_mark
    if mark is None:
        return _Mistake(0, 0, text, "")
    # libyaml counts one more line if the text does not end in a newline
    last = source.text.count("\n")
    is_beyond = mark.line > last
    line = min(mark.line, last)
    column = len(source.text) - source.text.rfind("\n") - 1 if is_beyond else mark.column
    before = lines[line][: column + 1] if line < len(lines) else ""
    return _Mistake(line, column, text, _hint(before) or _above(reason))


def _hint(before: str) -> str:
    """A hint for common mistakes in the line up to the error."""
    if "\t" in before:
        return "indent YAML with spaces, not tabs"
    if _RANGE_IN_LIST.search(before):
        return 'quote a range in a list: ["b[01-12]"]'
    if _RANGE_IN_BRACES.search(before):
        return 'quote a range inside braces: {"b[01-12]": ...}'
    if _MISSING_COMMA.search(before):
        return "separate entries with commas; quote a value that contains a colon and a space"
    if before.endswith(":") and before.count(": ") > 0:
        return "quote a value that contains a colon and a space"
    if before.endswith(("@", "`", "%")):
        return f"quote a value that begins with {before[-1]}"
    if before.endswith(("]", "}")):
        return f"remove the `{before[-1]}`, or add its opening bracket"
    return ""


def _above(reason: yaml.MarkedYAMLError) -> str:
    """A hint for errors that the parser notices only after the line with the mistake."""
    is_late = (reason.problem or "").startswith(_LATE)
    return "the mistake may be above: a missing `:`, quote or bracket, or another indentation" if is_late else ""


def _mistake(lines: Sequence[str], reason: yaml.MarkedYAMLError, quote: yaml.ScalarEvent | None) -> _Mistake | None:
    """The mistake, if the lines show what it is."""
    problem, mark, begin = reason.problem or "", reason.problem_mark, reason.context_mark
    if mark is None or mark.line > len(lines):
        return None
    stop = min(mark.line, len(lines) - 1)
    for number, line in enumerate(lines[: stop + 1]):
        if _CONFLICT.match(line):
            hint = "keep one of the two versions, and remove the lines `<<<<<<<`, `=======` and `>>>>>>>`"
            return _Mistake(number, 0, ": an unresolved merge conflict", hint)
    if begin is not None and reason.context == "while scanning a quoted scalar":
        return _open_quote(begin.line, begin.column)
    if quote is not None and quote.start_mark and quote.end_mark and quote.end_mark.line == mark.line:
        return _open_quote(quote.start_mark.line, quote.start_mark.column)
    if begin is not None and (reason.context or "").startswith("while parsing a flow") and mark.line > begin.line:
        return _open_bracket(lines, begin.line, begin.column, mark.line)
    if "\t" in lines[stop][: mark.column + 1]:
        return None
    if problem.startswith(_NO_COLON) and begin is not None:
        return _no_entry(lines, begin.line)
    if problem.startswith((*_NO_KEY, _NO_VALUE)):
        above = _content_above(lines, stop)
        if above is not None and not _is_entry(lines[above]) and _indent(lines[stop]) >= _indent(lines[above]):
            return _no_entry(lines, above)
        if lines[stop][: mark.column].strip() == "" or (problem.startswith(_NO_VALUE) and above is not None):
            return _odd_space(lines, stop) or _indentation(lines, stop)
    return None


def _open_quote(line: int, column: int) -> _Mistake:
    return _Mistake(line, column, ": a quote that is not closed on its line", "close it at the end of the value")


def _open_bracket(lines: Sequence[str], line: int, column: int, stop: int) -> _Mistake | None:
    """A list or mapping in brackets that the next line, or the end of the file, shows to be open; one that is meant to
    go on ends its line with a comma or a bracket."""
    rest = lines[line].partition(" #")[0].rstrip()
    if stop < len(lines) and (rest.endswith((",", "[", "{")) or _content_above(lines, stop) != line):
        return None
    opening = lines[line][column]
    closing = {"[": "]", "{": "}"}.get(opening, "")
    return _Mistake(line, column, f": `{opening}` is not closed", f"add the missing `{closing}`") if closing else None


def _odd_space(lines: Sequence[str], stop: int) -> _Mistake | None:
    """A space that is none, in the line or above it."""
    for number in (stop, _content_above(lines, stop)):
        found = None if number is None else _ODD_SPACE.search(lines[number])
        if number is not None and found is not None:
            text = f": the invisible character U+{ord(found.group()):04X}, which YAML takes for a letter"
            return _Mistake(number, found.start(), text, "type a space in its place, or nothing")
    return None


def _no_entry(lines: Sequence[str], number: int) -> _Mistake:
    """A line that should be `key: value` or `- item`."""
    if (odd := _odd_space(lines, number)) is not None and odd.line == number:
        return odd
    line = lines[number].strip()
    hint = "write `key: value`, with a colon and a space"
    if re.match(r"-\S", line):
        hint = "put a space after the hyphen of a list item"
    elif re.match(r"[\w.\[\]-]+:\S", line):
        hint = "put a space after the colon"
    elif re.match(r"[\w.-]+ *=", line):
        hint = "write a colon and a space, not `=`"
    return _Mistake(number, _indent(lines[number]), ": neither `key: value` nor a list item", hint)


def _indentation(lines: Sequence[str], stop: int) -> _Mistake | None:
    """Two lines of which one has a wrong indentation: the one that fits less to its neighbors."""
    above = _content_above(lines, stop)
    if above is None:
        return None
    here, there = _indent(lines[stop]), _indent(lines[above])
    if here > there:
        before = _content_above(lines, above)
        fits = before is not None and (
            _indent(lines[before]) == here or (lines[before].rstrip().endswith(":") and there <= _indent(lines[before]))
        )
        return _uneven(lines, above if fits else stop, stop, above)
    if here == there:
        text = f": neither a list item like line {above + 1}, nor indented less"
        return _Mistake(stop, here, text, "") if _LIST_ITEM.match(lines[above].strip()) else None
    begin = above
    while begin >= 0 and (not _is_content(lines[begin]) or _indent(lines[begin]) > here):
        begin -= 1
    first = next(number for number in range(begin + 1, stop) if _is_content(lines[number]))
    depth = _indent(lines[first])
    if depth <= here or not _is_entry(lines[first]):
        return None
    deeper = sum(_is_content(line) and _indent(line) == depth for line in lines[first:stop])
    shallower = 0
    for line in lines[stop:]:
        if _is_content(line) and _indent(line) < here:
            break
        shallower += _is_content(line) and _indent(line) == here
    return _uneven(lines, first if shallower >= deeper else stop, stop, first)


def _uneven(lines: Sequence[str], wrong: int, stop: int, other: int) -> _Mistake:
    text = (
        f": line {stop + 1} is indented by {counted(_indent(lines[stop]), 'space')}, "
        f"line {other + 1} by {_indent(lines[other])}"
    )
    hint = "indent the entries of one section alike, and deeper than the section's name"
    return _Mistake(wrong, _indent(lines[wrong]), text, hint)


def _content_above(lines: Sequence[str], number: int) -> int | None:
    return next((above for above in range(number - 1, -1, -1) if _is_content(lines[above])), None)


def _is_content(line: str) -> bool:
    text = line.strip()
    return bool(text) and not text.startswith("#")


def _is_entry(line: str) -> bool:
    text = line.strip()
    return bool(_KEY.match(text) or _LIST_ITEM.match(text))


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
