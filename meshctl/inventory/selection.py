"""One selection language for every command: words of the command line -> names, in the inventory's order. Pure.

A word is one term or several separated by commas:

    b03  'husky*'  b[01-12] a node by name, pattern or range
    beacons                 a group by name, where no node has that name
    B3  02:00:5e:00:00:03   a node by label, serial number or MAC, where no node or group has that name
    role:beacon  state:carried  mesh:main  group:spares  robot:spot1  site:north  hardware:box  release:24.10  label:B3
                            an attribute
    '!b07'  '!role:base'    excludes; a selection of exclusions alone starts from everything
    @FILE                   the terms in a file, one or more per line, `#` starts a comment

Words add to each other; `limits` (`--limit`) narrow the selection: each must select a candidate as well.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import TypeVar

from meshctl.errors import InputError
from meshctl.inventory.ranges import BadRange, expand
from meshctl.model import Fleet, Node, NodeState, Robot
from meshctl.suggest import did_you_mean
from meshctl.wording import join_limited

LIST_HINT = "run `meshctl inventory list` to list all nodes"
COMPUTER = "computer"
"""The role of a robot's computer, beside the roles of radios."""

# brackets that a pattern would read as a set of single characters: b[01-12] as b0, b1 and b2
_RANGE = re.compile(r"\[[^\]]*(?:,|\d\d+-|-\d\d)[^\]]*\]")
_COMMA = re.compile(r",(?![^\[]*\])")  # none inside brackets
_MAC = re.compile(r"(?:[0-9a-f]{2}:){5}[0-9a-f]{2}", re.IGNORECASE)
# attributes printed on a device; compared regardless of case
_PRINTED = ("label", "serial", "mac")
_MAX_HINT_VALUES = 12

Attributes = Mapping[str, Collection[str]]
"""Attributes that select a candidate, besides its name: attribute -> values."""

K = TypeVar("K", bound=Hashable)


@dataclass(frozen=True, slots=True)
class _Subject:
    """The kind of candidates: `what` names one in messages, `hint` follows the error for an unknown name, and
    `unmanaged` are nodes that a user may name although they are no candidates, with their states."""

    what: str
    hint: str
    unmanaged: Mapping[str, NodeState]


@dataclass(frozen=True, slots=True)
class Term:
    """`attribute` is empty for a name, pattern or group."""

    text: str
    attribute: str
    pattern: str
    is_exclusion: bool


def attributes_of(node: Node) -> Attributes:
    macs = (node.mac, *(radio.mac for radio in node.radios))
    return {
        "role": (node.role.value,),
        "state": (node.state.value,),
        "mesh": node.meshes,
        "group": node.groups,
        "robot": (node.robot,) if node.robot else (),
        "site": (node.site,) if node.site else (),
        "hardware": (node.hardware.name,),
        "release": (node.release.value,),
        "label": (node.label,) if node.label else (),
        "serial": (node.serial,) if node.serial else (),
        "mac": tuple(dict.fromkeys(mac for mac in macs if mac)),
    }


def robot_attributes(fleet: Fleet, robot: Robot) -> Attributes:
    """A robot's computer has the groups, states and meshes of its radios."""
    radios = [attributes_of(fleet.nodes[name]) for name in robot.nodes if name in fleet.nodes]
    of_radios = {key: tuple(value for each in radios for value in each[key]) for key in ("state", "mesh", "group")}
    return {"role": (COMPUTER,), "robot": (robot.name,), **of_radios}


def select_nodes(
    fleet: Fleet,
    words: Iterable[str],
    read_file: Callable[[str], str],
    limits: Iterable[str] = (),
    *,
    in_word_order: bool = False,
    with_unmanaged: bool = False,
) -> tuple[Node, ...]:
    """The nodes that the words select; all if there are none. Lost and retired ones only `with_unmanaged`.

    Raises InputError, see `select`.
    """
    nodes = {node.name: node for node in (fleet.nodes.values() if with_unmanaged else fleet.managed())}
    names = select(
        words,
        {name: attributes_of(node) for name, node in nodes.items()},
        read_file,
        limits,
        what=f"node of {fleet.name}" if with_unmanaged else f"managed node of {fleet.name}",
        hint=LIST_HINT,
        unmanaged=unmanaged_states(fleet),
        in_word_order=in_word_order,
    )
    return tuple(nodes[name] for name in names)


def unmanaged_states(fleet: Fleet) -> dict[str, NodeState]:
    """The lost and retired nodes, which commands for managed nodes explain when they are named."""
    return {node.name: node.state for node in fleet.nodes.values() if not node.state.is_managed}


def select_one(fleet: Fleet, word: str, read_file: Callable[[str], str], *, with_unmanaged: bool = False) -> Node:
    """The one node that the word selects. Raises InputError for none or several."""
    found = select_nodes(fleet, [word], read_file, with_unmanaged=with_unmanaged)
    if len(found) != 1:
        names = ", ".join(node.name for node in found)
        raise InputError(f"{word!r} selects {len(found)} nodes: expected one, found {names}")
    return found[0]


def select(
    words: Iterable[str],
    candidates: Mapping[K, Attributes],
    read_file: Callable[[str], str],
    limits: Iterable[str] = (),
    *,
    what: str,
    hint: str = "",
    unmanaged: Mapping[str, NodeState] = MappingProxyType({}),
    name_of: Callable[[K], str] = str,
    in_word_order: bool = False,
) -> tuple[K, ...]:
    """The candidates that the words select and every limit selects too; all if there are neither.

    They come in the candidates' order, or with `in_word_order` in that of the words. `read_file` returns the text of a
    file or raises OSError; `what` names a candidate in messages, `hint` follows the error for an unknown name, and
    `unmanaged` are nodes that are no candidates because of their states. Raises InputError for a term that selects
    nothing, an unknown attribute, an unreadable file, or a selection that leaves nothing.
    """
    named = {key: (name_of(key), attributes) for key, attributes in candidates.items()}
    subject = _Subject(what, hint, unmanaged)
    chosen = _select(tuple(words), named, read_file, subject)
    for limit in limits:
        allowed = set(_select((limit,), named, read_file, subject))
        left = [key for key in chosen if key in allowed]
        if chosen and not left:
            raise InputError(f"{limit}: selects no {what} among those selected without it")
        chosen = left
    if in_word_order:
        return tuple(chosen)
    remaining = set(chosen)
    return tuple(key for key in candidates if key in remaining)


_Named = Mapping[K, tuple[str, Attributes]]


def _select(
    words: tuple[str, ...], candidates: _Named[K], read_file: Callable[[str], str], subject: _Subject
) -> list[K]:
    """In the order of the terms, and for each in that of the candidates."""
    terms = tuple(_terms(words, read_file))
    if words and not terms:
        # an empty variable of a script, or an empty file, must not select everything
        raise InputError(f"{' '.join(repr(word) for word in words)}: selects no {subject.what}")
    chosen = {term: _matching(term, candidates, subject) for term in terms}
    included = [term for term in terms if not term.is_exclusion]
    found = [key for term in included for key in chosen[term]] if included else list(candidates)
    excluded = {key for term in terms if term.is_exclusion for key in chosen[term]}
    left = [key for key in dict.fromkeys(found) if key not in excluded]
    if terms and not left:
        raise InputError(f"{','.join(term.text for term in terms)}: selects no {subject.what}")
    return left


def _terms(words: Iterable[str], read_file: Callable[[str], str], source: str = "") -> Iterator[Term]:
    for text in (part.strip() for word in words for part in _COMMA.split(word)):
        if not text:
            continue
        if text.startswith("@") and not source:
            yield from _terms_of_file(text[1:], read_file)
            continue
        is_exclusion, bare = text.startswith("!"), text.removeprefix("!")
        attribute, colon, pattern = ("", "", bare) if _MAC.fullmatch(bare) else bare.partition(":")
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


def _matching(term: Term, candidates: _Named[K], subject: _Subject) -> list[K]:
    if term.attribute:
        return _matching_attribute(term, candidates, subject.what)
    named = _matcher(term.pattern)
    found = [key for key, (name, _) in candidates.items() if named(name)]
    for attribute in ("group", *_PRINTED):
        found = found or _having(attribute, term.pattern, candidates, exactly=True)
    found = found or [key for key, (name, _) in candidates.items() if name.lower() == term.pattern.lower()]
    if not found:
        if state := subject.unmanaged.get(term.pattern):
            # a similar name instead would be another device
            raise InputError(
                f"{term.pattern} is {state.value}: meshctl does not manage lost and retired nodes",
                hint=f"if it is back, run `meshctl inventory state {term.pattern} deployed`",
            )
        known = [*(name for name, _ in candidates.values()), *_values("group", candidates)]
        raise InputError(
            f"no {subject.what} matches {term.pattern!r}",
            hint=_pattern_hint(term.pattern, candidates)
            or _other_language(term.pattern)
            or did_you_mean(term.pattern, known)
            or subject.hint,
        )
    return found


def _pattern_hint(text: str, candidates: _Named[K]) -> str:
    """For the beginning of several names, such as a name whose end is not typed yet: one of them would be a guess."""
    count = sum(name.startswith(text) for name, _ in candidates.values())
    return f"{count} names begin with it: '{text}*' selects them" if count > 1 else ""


def _other_language(text: str) -> str:
    """For what is meant as a selection elsewhere: a path, Ansible's `all`, `role=beacon`."""
    if text in (".", "..") or "/" in text or text.endswith((".yaml", ".yml")):
        return f"to name another inventory, write `-i {text}`"
    if text == "all":
        return "leave the name out, or write '*', for all nodes"
    attribute, equals, value = text.partition("=")
    if equals and value:
        return f"write {attribute}:{value}"
    return ""


def _matching_attribute(term: Term, candidates: _Named[K], what: str) -> list[K]:
    attributes = dict.fromkeys(key for _, each in candidates.values() for key in each)
    if term.attribute not in attributes:
        near = f"tags are groups: group:{term.pattern}" if term.attribute in ("tag", "tags") else ""
        raise InputError(
            f"{term.text!r}: unknown attribute {term.attribute!r}",
            hint=near or did_you_mean(term.attribute, attributes) or f"expected one of: {', '.join(attributes)}",
        )
    found = _having(term.attribute, term.pattern, candidates)
    if not found:
        values = _values(term.attribute, candidates)
        raise InputError(
            f"no {what} has {term.attribute} {term.pattern!r}",
            hint=did_you_mean(term.pattern, values) or f"found: {join_limited(values, _MAX_HINT_VALUES) or 'none'}",
        )
    return found


def _having(attribute: str, pattern: str, candidates: _Named[K], *, exactly: bool = False) -> list[K]:
    fold = str.lower if attribute in _PRINTED else str
    wanted = fold(pattern)
    matches = wanted.__eq__ if exactly and not _RANGE.search(wanted) else _matcher(wanted)
    return [
        key for key, (_, each) in candidates.items() if any(matches(fold(value)) for value in each.get(attribute, ()))
    ]


def _matcher(pattern: str) -> Callable[[str], bool]:
    """Whether a name matches a pattern, or is one of a range. Raises InputError for an invalid range."""
    if not _RANGE.search(pattern):
        return lambda name: fnmatchcase(name, pattern)
    try:
        patterns = expand(pattern)
    except BadRange as error:
        raise InputError(f"{pattern!r}: invalid range: {error}", hint="for example: 'b[01-12]'") from None
    if not any(mark in pattern for mark in "*?"):
        return frozenset(patterns).__contains__
    return lambda name: any(fnmatchcase(name, each) for each in patterns)


def _values(attribute: str, candidates: _Named[K]) -> list[str]:
    return list(dict.fromkeys(value for _, each in candidates.values() for value in each.get(attribute, ())))
