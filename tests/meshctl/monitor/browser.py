"""A real browser for the page: Debian's chromium, driven by Playwright, which downloads nothing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

NEEDS_BROWSER = "MESHCTL_TESTS_NEED_BROWSER"
CHROMIUM = "chromium"
# no sandbox: tests may run as root; no request to the browser's vendor
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
# Generous: this machine may be slow.
PATIENCE_MS = 60_000.0


def has_browser() -> bool:
    return shutil.which(CHROMIUM) is not None


def expects_browser() -> bool:
    """Whether to run tests with a real browser: if it is installed or required."""
    return has_browser() or bool(os.environ.get(NEEDS_BROWSER))


@contextmanager
def chromium() -> Iterator[Browser]:
    """Skips the test without chromium, unless it is required."""
    if not expects_browser():
        pytest.skip(f"there is no {CHROMIUM}; scripts/setup-browser installs it, {NEEDS_BROWSER}=1 makes this fail")
    program = shutil.which(CHROMIUM)
    assert program is not None, f"{NEEDS_BROWSER} is set, but there is no {CHROMIUM}: run scripts/setup-browser"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(browser: Browser, url: str, *, width: int = 1280, height: int = 800) -> Iterator[Page]:
    """The page at `url` with data in it; fails for an error on its console and for any request to another host."""
    problems: list[str] = []
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(PATIENCE_MS)
    page.on("pageerror", lambda error: problems.append(f"error: {error}"))
    # a lost connection is an error on the console of its own
    page.on(
        "console",
        lambda line: (
            problems.append(f"console: {line.text}") if line.type == "error" and "net::ERR_" not in line.text else None
        ),
    )
    page.on("request", lambda asked: None if is_ours(asked.url, url) else problems.append(f"request: {asked.url}"))
    try:
        page.goto(url)
        page.wait_for_selector("html[data-shown]", state="attached")
        yield page
    finally:
        page.close()
    assert not problems, problems


def is_ours(asked: str, url: str) -> bool:
    """Whether a request goes to the page's own server or file."""
    if url.startswith("file:"):
        return asked == url or asked.startswith("blob:")
    return asked.startswith((url.split("#", maxsplit=1)[0], "blob:"))


def file_url(path: Path) -> str:
    return path.resolve().as_uri()
