"""The rules' pages are what their code says."""

import re
from types import ModuleType

import pytest

from meshctl.lint import RULES
from meshctl.lint.catalog import CHAPTERS, rules_of
from meshctl.lint.pages import pages
from meshctl.resources import shipped


def test_the_pages_in_the_repository_are_up_to_date() -> None:
    directory = shipped("lint")
    written = {file.name: file.read_text(encoding="utf-8") for file in directory.glob("*.md")}
    assert written == pages(), "run: python -m meshctl.lint.pages docs/lint"


def test_every_rule_is_in_one_chapter_with_a_unique_name_and_title() -> None:
    chaptered = [rule for _, module in CHAPTERS for rule in rules_of(module)]
    assert sorted(rule.code for rule in chaptered) == [rule.code for rule in RULES]
    assert len({rule.name for rule in RULES}) == len(RULES)
    assert len({rule.title for rule in RULES}) == len(RULES)


@pytest.mark.parametrize(("title", "module"), CHAPTERS, ids=[title for title, _ in CHAPTERS])
def test_a_chapter_states_the_range_of_its_codes(title: str, module: ModuleType) -> None:
    codes = [rule.code for rule in rules_of(module)]
    assert codes == sorted(codes), title
    span = re.search(r"\((MC\d{3})(?: to (MC\d{3}))?\)", (module.__doc__ or "").replace("\n", " "))
    assert span is not None, title
    assert (span[1], span[2] or span[1]) == (codes[0], codes[-1])
