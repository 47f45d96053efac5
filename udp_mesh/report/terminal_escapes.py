"""What peers, daemons and recordings said, made safe for a terminal: every character that could steer it is shown as a
visible stand-in.

Names, types and reasons come from other programs and other machines. They may hold escape sequences that clear the
screen or write to the clipboard, or bidirectional marks that reorder a line. Each stand-in is one character wide.
"""

from __future__ import annotations

_REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
# Unicode's pictures of the C0 controls begin here, DEL has its own
_CONTROL_PICTURES = 0x2400
_DELETE = 0x7F
_DELETE_PICTURE = "\N{SYMBOL FOR DELETE}"


def clean(text: str, *, keep: str = "\n\t") -> str:
    """The text with control, format and bidirectional characters, lone surrogates and unassigned characters replaced.

    `keep` are control characters that pass: line ends and tabs for text of several lines.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(one if one in keep or _is_harmless(one) else _stand_in(one) for one in text)


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
