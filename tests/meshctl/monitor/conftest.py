"""One browser for each module of the page's tests. The tests with a real prometheus are collected where there is one
(scripts/setup-prometheus)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.meshctl.monitor.browser import chromium
from tests.meshctl.monitor.prometheus_program import expects_prometheus

collect_ignore = [] if expects_prometheus() else ["test_prometheus.py"]


# Not for the whole session: while it is open, Playwright's event loop runs in the main thread, and no other can.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started
