"""docs/render.md describes every code that these packages use, and no other."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGES = ("uci", "resolve", "render", "firmware")


def test_every_diagnostic_code_is_documented() -> None:
    sources = (path.read_text() for package in PACKAGES for path in (ROOT / "meshctl" / package).glob("*.py"))
    used = {code for text in sources for code in re.findall(r'"((?:UCI|RND|FW)\d{3})"', text)}
    explained = re.findall(r"^\| ((?:UCI|RND|FW)\d{3}) \|", (ROOT / "docs/render.md").read_text(), re.MULTILINE)
    assert sorted(used) == sorted(explained)
