"""The reader against the real one: texts, and what libuci's own `uci export` printed for them (null: it refused).

Recorded with OpenWrt's uci, commit 66127cd of 2025-12-02, built for Linux; the text is what `uci -c DIR export x`
prints behind its first line.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.uci import dump, parse

CASES: list[tuple[str, str | None]] = json.loads((Path(__file__).parent / "libuci_cases.json").read_text())


@pytest.mark.parametrize(("text", "exported"), CASES)
def test_every_text_parses_as_in_libuci(text: str, exported: str | None) -> None:
    if exported is None:
        with pytest.raises(InvalidInput):
            parse(text, "x")
    else:
        assert dump(parse(text, "x")) == exported
