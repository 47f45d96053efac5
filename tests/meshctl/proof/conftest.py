"""One virtual fleet for all default tests of this folder: they run one after the other on one worker."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.meshctl.proof.rig import Rig


@pytest.fixture(scope="session")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """A base and four nodes that run inventory `a` or, after `flip`, `b`."""
    with Rig(tmp_path_factory.mktemp("proof"), 4) as started:
        taken = started.take_in(started.current)
        assert (taken.code, set(taken.results.values())) == (0, {"done"}), taken.out + taken.err
        yield started
