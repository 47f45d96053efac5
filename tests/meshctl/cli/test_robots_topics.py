"""Values of `meshctl robots topic set KEY=VALUE`."""

from __future__ import annotations

import pytest

from meshctl.cli.robots_topics import _fields
from meshctl.errors import InputError


@pytest.mark.parametrize("text", ["[" * 5_000, "2026-99-99", "[a", "{a: 1}", "!!python/name:os.system"])
def test_a_value_that_is_no_yaml_value_is_an_error_that_names_its_key(text: str) -> None:
    with pytest.raises(InputError, match=r"priority: expected a "):
        _fields([f"priority={text}"])
