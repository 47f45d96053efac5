"""How messages count and list things."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from meshctl.plan.values import FileChange
from meshctl.report.changed_options import settings
from meshctl.wording import counted, join_limited, lock_owners, two_digits

_ROOT = Path(__file__).resolve().parents[2]
# `{count} node{'s' if count != 1 else ''}`
_BY_HAND = re.compile(r"\{'s' if |\{'' if [^}]* else 's'\}|else 's'\}")


@pytest.mark.parametrize(("number", "text"), [(0, "0 lines"), (1, "1 line"), (2, "2 lines")])
def test_a_count_of_one_is_singular(number: int, text: str) -> None:
    assert counted(number, "line") == text


def test_a_long_list_ends_with_the_number_of_others() -> None:
    assert join_limited(["a", "b", "c"]) == "a, b, c"
    assert join_limited([f"h{number}" for number in range(75)]) == "h0, h1, h2, h3 and 71 more"


def test_the_owner_of_a_lock_is_an_operator_and_a_process() -> None:
    text = "change: held by ann@lap-top.local:17:4711 for another 149 s"
    assert lock_owners(text) == "change: held by ann@lap-top.local (process 17) for another 149 s"
    for text in ("ann@laptop", "alice@laptop:run-7", "10.42.0.11:22:5 is closed", ""):
        assert lock_owners(text) == text


def test_one_changed_line_without_a_setting_is_one_line() -> None:
    change = FileChange("etc/rc.local", "changed", "--- a\n+++ b\n@@ -1 +1 @@\n-exit 0\n+exit 1\n")
    assert settings(change) == ("2 lines",)
    added = FileChange("etc/rc.local", "changed", "--- a\n+++ b\n@@ -1 +1,2 @@\n exit 0\n+exit 1\n")
    assert settings(added) == ("1 line",)


@pytest.mark.parametrize("package", ["meshctl", "meshlab"])
def test_counts_are_worded_in_one_place(package: str) -> None:
    files = [path for path in (_ROOT / package).rglob("*.py") if path.name != "wording.py"]
    assert files
    found = [str(path) for path in files if _BY_HAND.search(path.read_text(encoding="utf-8"))]
    assert found == []


@pytest.mark.parametrize(
    ("number", "text"), [(0.0751, "0.075"), (1, "1"), (7.46, "7.5"), (9.99, "10"), (15.2, "15"), (100.4, "100")]
)
def test_a_rounded_number_has_no_exponent(number: float, text: str) -> None:
    assert two_digits(number) == text
