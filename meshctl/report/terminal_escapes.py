"""What devices said, made safe for a terminal: every character that could steer it is shown as a visible stand-in.

A device in the field can be touched by anyone, so its board name, its log or its command output may hold escape
sequences that clear the screen, set the window's title or write to the clipboard, or bidirectional marks that reorder a
line. `clean` is the one place that decides which characters pass. Each stand-in is one character wide, so columns stay.
"""

from __future__ import annotations

import re

_REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
# Unicode's pictures of the C0 controls begin here, DEL has its own
_CONTROL_PICTURES = 0x2400
_DELETE = 0x7F
_DELETE_PICTURE = "\N{SYMBOL FOR DELETE}"
# Select Graphic Rendition (ECMA-48 8.3.117): colours and weights, and nothing else
_STYLE = re.compile(r"(\x1b\[[0-9;]*m)")


def clean(text: str, *, keep: str = "\n\t") -> str:
    """The text with control, format and bidirectional characters, lone surrogates and unassigned characters replaced.

    `keep` are control characters that pass: line ends and tabs for text of several lines.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(one if one in keep or _is_harmless(one) else _stand_in(one) for one in text)


def one_line(text: str) -> str:
    """`clean` for a value within a line: a line end in it begins no line of its own."""
    return clean(text, keep="\t")


def clean_styled(text: str) -> str:
    """`clean` for text that meshctl has coloured itself, out of parts that were cleaned before: colours pass."""
    parts = _STYLE.split(text)
    return "".join(part if place % 2 else clean(part) for place, part in enumerate(parts))


def json_safe(text: str) -> str:
    """JSON text with the same characters escaped; it means the same, since JSON has them only within strings."""
    if text.isascii() and "\x7f" not in text:
        return text
    return "".join(one if one == "\n" or _is_harmless(one) else _escaped(one) for one in text)


def _is_harmless(one: str) -> bool:
    # the spaces of other scripts are not "printable" to Python
    return one.isprintable() or one in "\xa0\u3000\u202f"


def _stand_in(one: str) -> str:
    code = ord(one)
    if code < ord(" "):
        return chr(_CONTROL_PICTURES + code)
    return _DELETE_PICTURE if code == _DELETE else _REPLACEMENT


def _escaped(one: str) -> str:
    units = one.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))
