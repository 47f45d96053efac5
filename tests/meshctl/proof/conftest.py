"""One virtual fleet for most tests of this folder; each begins with all of it whole, in whichever order they run."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.meshctl.proof.rig import Rig


@pytest.fixture(scope="session")
def shared_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with Rig(tmp_path_factory.mktemp("proof"), 4) as started:
        taken = started.take_in(started.current)
        assert (taken.code, set(taken.results.values())) == (0, {"done"}), taken.out + taken.err
        yield started


@pytest.fixture
def rig(shared_rig: Rig) -> Rig:
    """A base and four nodes that run inventory `rig.current`, which is `a` or `b`."""
    shared_rig.settle()
    return shared_rig
