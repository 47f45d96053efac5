"""Lines wrapped at the width of a terminal, with continuations indented below them."""

from __future__ import annotations

import textwrap

# below this width, words are broken
_MIN_WIDTH = 20


def wrap(text: str, width: int | None) -> list[str]:
    """`text` in lines of at most `width` columns; whole without a width."""
    if width is None or len(text) <= width:
        return [text]
    indent = " " * (len(text) - len(text.lstrip()) + 2)
    return textwrap.wrap(text, max(width, _MIN_WIDTH), subsequent_indent=indent, break_on_hyphens=False)
