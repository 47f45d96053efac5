"""`--leave-behind` and `--accept-cut` take the words that select nodes everywhere."""

from __future__ import annotations

import pytest

from meshctl.cli.plan_execution import choices_of
from meshctl.errors import InputError
from tests.meshctl.plan.support import fleet


@pytest.mark.parametrize(
    ("words", "nodes"),
    [
        (None, ()),
        ([""], ()),
        (["b02, b01"], ("b01", "b02")),
        (["b02", "b01"], ("b01", "b02")),
        (["role:base"], ("base",)),
        (["b0*,!b03"], ("b01", "b02", "b04", "b05")),
        (["b01,all"], ("all",)),
    ],
)
def test_the_words_that_select_nodes_acknowledge_them(words: list[str] | None, nodes: tuple[str, ...]) -> None:
    choices = choices_of(fleet(), False, words, words)
    assert (choices.leave_behind, choices.accept_cuts) == (nodes, nodes)


def test_a_misspelt_name_is_an_error_and_not_ignored() -> None:
    with pytest.raises(InputError, match="no node of team matches 'b0x'"):
        choices_of(fleet(), False, ["b0x"], None)


def test_a_site_accepts_names_that_its_part_of_the_inventory_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MESHCTL_SITE_FILES", "/tmp")
    assert choices_of(fleet(), False, ["elsewhere"], None).leave_behind == ("elsewhere",)
