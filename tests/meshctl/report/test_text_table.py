"""Tables and sentences on a narrow terminal: columns are left out, words and commands stay whole."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.report import text_table
from meshctl.report.line_wrap import wrap

HEADING = ("NODE", "ROLE", "LABEL", "ROBOT")
ROWS = (("kit01-radio", "robot", "-", "kit01"), ("judge", "base", "-", "judges"))


def test_a_table_that_fits_is_whole() -> None:
    whole = text_table.lines(HEADING, ROWS, leave_out=("ROBOT", "LABEL"))
    assert whole == [
        "NODE         ROLE   LABEL  ROBOT",
        "kit01-radio  robot  -      kit01",
        "judge        base   -      judges",
    ]
    assert text_table.lines(HEADING, ROWS, 40, leave_out=("ROBOT", "LABEL")) == whole


def test_columns_without_values_are_left_out_first_and_named() -> None:
    assert text_table.lines(HEADING, ROWS, 30, leave_out=("ROBOT", "LABEL")) == [
        "NODE         ROLE   ROBOT",
        "kit01-radio  robot  kit01",
        "judge        base   judges",
        "columns not shown: label (use",
        "  --json)",
    ]
    narrowest = text_table.lines(HEADING, ROWS, 20, leave_out=("ROBOT", "LABEL"))
    assert narrowest[:3] == ["NODE         ROLE", "kit01-radio  robot", "judge        base"]
    assert " ".join(line.strip() for line in narrowest[3:]) == "columns not shown: label, robot (use --json)"


def test_a_column_that_fits_again_is_shown() -> None:
    rows = (("a", "12", "quay 5g ch 100, water 2g ch 11"),)
    drawn = text_table.lines(("LINK", "HEARD", "CELL"), rows, 20, leave_out=("HEARD", "CELL"))
    assert drawn[:2] == ["LINK  HEARD", "a     12"]


@given(st.integers(1, 200))
def test_no_cell_is_ever_cut(width: int) -> None:
    drawn = text_table.lines(HEADING, ROWS, width, leave_out=("ROBOT", "LABEL", "ROLE"))
    assert [line.split()[0] for line in drawn[1:3]] == ["kit01-radio", "judge"]


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_command_in_backticks_stays_on_one_line(width: int) -> None:
    text = "error: another device, or an attack: verify, then run `meshctl robots trust --replace r1` there"
    drawn = wrap(text, width)
    assert max(map(len, drawn)) <= width
    assert any("`meshctl robots trust --replace r1`" in line for line in drawn)
    assert " ".join(line.strip() for line in drawn) == text
