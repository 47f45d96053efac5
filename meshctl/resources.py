"""Files shipped with meshctl: templates, example inventories, lint pages, scripts for nodes.

In a checkout they are at the top of the repository, in an installed wheel inside the package (see pyproject.toml).
"""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_SHIPPED = _PACKAGE / "_shipped"
_CHECKOUT = {"templates": "templates", "inventory": "inventory", "lint": "docs/lint"}


def device_script(name: str) -> str:
    """A shell script for nodes that is also one of their files."""
    return (_PACKAGE / "device" / "scripts" / name).read_text(encoding="utf-8")


def shipped(kind: str) -> Path:
    """The directory of `kind`: `templates`, `inventory` (the examples) or `lint` (the rules' pages)."""
    if _SHIPPED.is_dir():
        return _SHIPPED / kind
    return _PACKAGE.parent / _CHECKOUT[kind]
