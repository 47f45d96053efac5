"""Makes text from peers, daemons and recordings safe for a terminal by replacing every control character.

Names, types and reasons come from other programs and machines. They may contain escape sequences that clear the screen
or write to the clipboard, or bidirectional marks that reorder a line. Each replacement is one character wide.
"""

from __future__ import annotations

_REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
# Unicode's control pictures for C0 start here; DEL has its own.
_CONTROL_PICTURES = 0x2400
_DELETE = 0x7F
_DELETE_PICTURE = "\N{SYMBOL FOR DELETE}"


def clean(text: str, *, keep: str = "\n\t") -> str:
    """Replaces control, format and bidirectional characters, lone surrogates and unassigned characters.

    `keep` lists control characters to preserve: line ends and tabs for multi-line text.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character if character in keep or _is_harmless(character) else _stand_in(character) for character in text
    )


def json_safe(text: str) -> str:
    """Escapes the same characters in JSON text, which does not change its meaning: they only occur in strings."""
    if text.isascii() and "\x7f" not in text:
        return text
    return "".join(
        character if character == "\n" or _is_harmless(character) else _escaped(character) for character in text
    )


def _is_harmless(character: str) -> bool:
    # Python does not consider the spaces of other scripts printable.
    return character.isprintable() or character in "\xa0\u3000\u202f"


def _stand_in(character: str) -> str:
    code = ord(character)
    if code < ord(" "):
        return chr(_CONTROL_PICTURES + code)
    return _DELETE_PICTURE if code == _DELETE else _REPLACEMENT


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))
