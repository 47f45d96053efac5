"""Sanitize output of devices for a terminal: control characters become visible replacements.

Devices in the field are not trusted: a board name, log or command output may contain escape sequences that clear the
screen, set the window title or write to the clipboard, or bidirectional marks that reorder a line. `clean` decides
which characters pass. Replacements are one character wide, which keeps columns aligned.
"""

from __future__ import annotations

import re

_REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
# first of Unicode's control pictures for C0; DEL has its own
_CONTROL_PICTURES = 0x2400
_DELETE = 0x7F
_DELETE_PICTURE = "\N{SYMBOL FOR DELETE}"
# Select Graphic Rendition (ECMA-48 8.3.117): colors and weights only
_STYLE = re.compile(r"(\x1b\[[0-9;]*m)")


def clean(text: str, *, keep: str = "\n\t") -> str:
    """The text with control, format and bidirectional characters, lone surrogates and unassigned characters replaced.

    `keep` are control characters that pass: line ends and tabs for text of several lines.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character if character in keep or _is_harmless(character) else _replacement(character) for character in text
    )


def one_line(text: str) -> str:
    """`clean` for a value within a line: line ends are replaced too."""
    return clean(text, keep="\t")


def clean_styled(text: str) -> str:
    """`clean` for text with meshctl's own colors: SGR sequences pass. Its parts must have been cleaned before."""
    parts = _STYLE.split(text)
    return "".join(part if place % 2 else clean(part) for place, part in enumerate(parts))


def json_safe(text: str) -> str:
    """JSON text with the same characters escaped, which keeps its value: JSON has them only within strings."""
    if text.isascii() and "\x7f" not in text:
        return text
    return "".join(
        character if character == "\n" or _is_harmless(character) else _escaped(character) for character in text
    )


def _is_harmless(character: str) -> bool:
    # str.isprintable() excludes these spaces
    return character.isprintable() or character in "\xa0\u3000\u202f"


def _replacement(character: str) -> str:
    code = ord(character)
    if code < ord(" "):
        return chr(_CONTROL_PICTURES + code)
    return _DELETE_PICTURE if code == _DELETE else _REPLACEMENT


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))
