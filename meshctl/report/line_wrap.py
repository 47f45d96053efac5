"""Lines wrapped at the width of a terminal, with continuations indented below them."""

from __future__ import annotations

import re
import textwrap

# a command or a value, which is copied as a whole
_QUOTED = re.compile(r"`[^`]*`")
# stands for a space within one
_JOINT = "\0"
# below this width, words are broken
_MIN_WIDTH = 20


def wrap(text: str, width: int | None) -> list[str]:
    """`text` in lines of at most `width` columns; whole without a width. What is in `backticks` stays on one line if it
    fits."""
    if width is None or len(text) <= width:
        return [text]
    width = max(width, _MIN_WIDTH)
    indent = " " * (len(text) - len(text.lstrip()) + 2)

    def joined(quoted: re.Match[str]) -> str:
        fits = len(quoted.group()) + len(indent) < width
        return quoted.group().replace(" ", _JOINT) if fits else quoted.group()

    lines = textwrap.wrap(_QUOTED.sub(joined, text), width, subsequent_indent=indent, break_on_hyphens=False)
    return [line.replace(_JOINT, " ") for line in lines]
