"""One selection language for every command: words of the command line -> names, in the inventory's order. Pure.

A word is one term or several separated by commas:

    b03  'husky*'           a node by name or pattern
    beacons                 a group by name, where no node has that name
    role:beacon  state:carried  mesh:main  group:spares  robot:spot1  hardware:box  release:24.10    an attribute
    '!b07'  '!role:base'    excludes; a selection of exclusions alone starts from everything
    @FILE                   the terms in a file, one or more per line, `#` starts a comment
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

from meshctl.errors import InputError
from meshctl.inventory.suggest import did_you_mean
from meshctl.model import Fleet, Node

LIST_HINT = "run `meshctl inventory list` to list all nodes"

Attributes = Mapping[str, Collection[str]]
"""What a candidate can be selected by besides its name: attribute -> values."""


@dataclass(frozen=True, slots=True)
class Term:
    """`attribute` is empty for a name, pattern or group."""

    text: str
    attribute: str
    pattern: str
    is_exclusion: bool


def attributes_of(node: Node) -> Attributes:
    return {
        "role": (node.role.value,),
        "state": (node.state.value,),
        "mesh": node.meshes,
        "group": node.groups,
        "robot": (node.robot,) if node.robot else (),
        "hardware": (node.hardware.name,),
        "release": (node.release.value,),
    }


def select_nodes(fleet: Fleet, words: Iterable[str], read_file: Callable[[str], str]) -> tuple[Node, ...]:
    """The managed nodes that the words select; all if there are none. Raises InputError, see `select`."""
    managed = {node.name: node for node in fleet.managed()}
    candidates = {name: attributes_of(node) for name, node in managed.items()}
    names = select(words, candidates, read_file, what=f"managed node of {fleet.name}", hint=LIST_HINT)
    return tuple(managed[name] for name in names)


def select(
    words: Iterable[str],
    candidates: Mapping[str, Attributes],
    read_file: Callable[[str], str],
    *,
    what: str,
    hint: str = "",
) -> tuple[str, ...]:
    """The names that the words select, in the candidates' order; all if there are no words.

    `read_file` returns the text of a file or raises OSError; `what` names a candidate in messages, `hint` follows
    the error for an unknown name. Raises InputError for a term that selects nothing, an unknown attribute, an
    unreadable file, or a selection that leaves nothing.
    """
    terms = tuple(_terms(words, read_file))
    chosen = {term: _matching(term, candidates, what, hint) for term in terms}
    included = [term for term in terms if not term.is_exclusion]
    names = {name for term in included for name in chosen[term]} if included else set(candidates)
    left = names.difference(*(chosen[term] for term in terms if term.is_exclusion))
    if terms and not left:
        raise InputError(f"{','.join(term.text for term in terms)}: selects no {what}")
    return tuple(name for name in candidates if name in left)


def _terms(words: Iterable[str], read_file: Callable[[str], str], source: str = "") -> Iterator[Term]:
    for text in (part.strip() for word in words for part in word.split(",")):
        if not text:
            continue
        if text.startswith("@") and not source:
            yield from _terms_of_file(text[1:], read_file)
            continue
        is_exclusion, bare = text.startswith("!"), text.removeprefix("!")
        attribute, colon, pattern = bare.partition(":")
        if not bare or bare.startswith("@") or (colon and not pattern):
            raise InputError(
                f"{source}{text!r}: expected a name, a pattern, ATTRIBUTE:VALUE or !TERM",
                hint="for example: b03 'husky*' role:beacon '!b07' @FILE",
            )
        yield Term(text, attribute if colon else "", pattern if colon else bare, is_exclusion)


def _terms_of_file(path: str, read_file: Callable[[str], str]) -> Iterator[Term]:
    try:
        text = read_file(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"@{path}: cannot read the selection: {reason}") from None
    for number, line in enumerate(text.splitlines(), 1):
        yield from _terms(line.partition("#")[0].split(), read_file, source=f"{path}:{number}: ")


def _matching(term: Term, candidates: Mapping[str, Attributes], what: str, hint: str) -> set[str]:
    if term.attribute:
        return _matching_attribute(term, candidates, what)
    by_name = {name for name in candidates if fnmatchcase(name, term.pattern)}
    found = by_name or {name for name, each in candidates.items() if term.pattern in each.get("group", ())}
    if not found:
        known = [*candidates, *_values("group", candidates)]
        raise InputError(
            f"no {what} matches {term.pattern!r}",
            hint=did_you_mean(term.pattern, known) or hint,
        )
    return found


def _matching_attribute(term: Term, candidates: Mapping[str, Attributes], what: str) -> set[str]:
    attributes = dict.fromkeys(key for each in candidates.values() for key in each)
    if term.attribute not in attributes:
        raise InputError(
            f"{term.text!r}: unknown attribute {term.attribute!r}",
            hint=did_you_mean(term.attribute, attributes) or f"expected one of: {', '.join(attributes)}",
        )
    found = {
        name
        for name, each in candidates.items()
        if any(fnmatchcase(value, term.pattern) for value in each.get(term.attribute, ()))
    }
    if not found:
        values = _values(term.attribute, candidates)
        raise InputError(
            f"no {what} has {term.attribute} {term.pattern!r}",
            hint=did_you_mean(term.pattern, values) or f"found: {', '.join(values) or 'none'}",
        )
    return found


def _values(attribute: str, candidates: Mapping[str, Attributes]) -> list[str]:
    return list(dict.fromkeys(value for each in candidates.values() for value in each.get(attribute, ())))
