"""Tree -> canonical text, byte for byte as `uci export` and `uci commit` write it.

`quote` is the only function in meshctl that quotes UCI values.
"""

from __future__ import annotations

import re

from meshctl.uci.tree import Package, Section

# A section type that reads back unchanged although libuci does not quote types.
_PLAIN_TYPE = re.compile(r"[^'\"\\#;]+")


def dump(package: Package, *, header: bool = False) -> str:
    """The text of a package file; with `header`, a block of `uci export`, which starts with `package NAME`."""
    parts = [f"package {_plain(package.name)}\n"] if header else []
    for section in package.sections:
        parts.append(_section(section))
    parts.append("\n")
    return "".join(parts)


def _section(section: Section) -> str:
    lines = [f"\nconfig {_plain(section.type)}" + (f" {quote(section.name)}" if section.name is not None else "")]
    for name, value in section.options.items():
        if isinstance(value, str):
            lines.append(f"\toption {name} {quote(value)}")
        else:
            lines.extend(f"\tlist {name} {quote(item)}" for item in value)
    lines.append("")
    return "\n".join(lines)


def _plain(word: str) -> str:
    return word if _PLAIN_TYPE.fullmatch(word) else quote(word)


def quote(value: str) -> str:
    """`value` as one UCI argument that reads back unchanged: in single quotes, a quote as `'\\''` (file.c, uci_escape).

    Newlines, other control characters and non-ASCII letters stay as they are. Raises ValueError for a NUL, which C
    strings cannot contain.
    """
    if "\0" in value:
        raise ValueError("expected text, found a NUL byte")
    return "'" + value.replace("'", "'\\''") + "'"
