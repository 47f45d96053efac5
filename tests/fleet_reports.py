"""A plugin: the report of a test that fails on a virtual fleet includes the state of its nodes."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from tests.meshlab.fleet_report import fleets_of, report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add what the test's fleets say of their nodes to the report of a failure, while they still run."""
    made = yield
    if made.failed and isinstance(item, pytest.Function):
        for fleet in fleets_of(item.funcargs.values()):
            made.sections.append(("nodes", report(fleet, made.longreprtext)))
    return made
