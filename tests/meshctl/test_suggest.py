"""Suggestions for misspelled names: one if one is nearest, all that are equally near, none instead of a guess."""

from __future__ import annotations

import pytest

from meshctl.lint.openwrt_names import suggest_packages
from meshctl.suggest import did_you_mean


@pytest.mark.parametrize(
    ("wrong", "known", "hint"),
    [
        ("chanel", ["channel", "country"], "did you mean 'channel'?"),
        ("tx-power", ["tx_power", "tx_powers"], "did you mean 'tx_power'?"),
        ("b4", ["b1", "b2"], ""),
        ("husky4", ["husky1", "husky2", "spot"], "did you mean 'husky1' or 'husky2'?"),
        ("husky4", ["husky1", "husky2", "husky3"], "did you mean 'husky1', 'husky2' or 'husky3'?"),
        ("husky5", ["husky1", "husky2", "husky3", "husky4"], ""),
        ("huskyy1", ["husky1", "husky2", "husky3", "husky4"], "did you mean 'husky1'?"),
    ],
)
def test_all_names_that_are_equally_near_are_suggested_unless_they_are_many(
    wrong: str, known: list[str], hint: str
) -> None:
    assert did_you_mean(wrong, known) == hint


def test_of_packages_all_that_are_one_edit_away_are_suggested() -> None:
    assert suggest_packages("kmod-ath8k") == ("kmod-ath5k", "kmod-ath9k")
