"""The monitor's page in a browser: `python -m benchmarks.monitor_page [--radios 200] [--robots 20] [--fill]`.

A server with the frames of `monitor_fleet` and Debian's chromium without a graphics card, both on this machine:

- **fresh data**: from the moment that a frame is in the history to the moment that the page shows it;
- **pan and zoom**, and **play at 10x** with the radios' table open: the time between two animation frames, 16.7 ms at
  60 Hz, and the longest task of the page's main thread.

*CPU* is the main thread's processor time: for each fresh frame, or the share of the time that it was busy.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from playwright.sync_api import Page

from benchmarks.monitor_fleet import TOPIC_CLASSES, TunnelRun
from benchmarks.page import fill, this_machine
from meshctl.monitor.frame import Frame
from meshctl.monitor.server import PageSettings
from meshctl.monitor.store import FrameStore
from tests.meshctl.monitor.browser import chromium, opened
from tests.meshctl.monitor.served import Served, served

RESULTS = Path(__file__).with_name("results") / "monitor_page.jsonl"
PAST, FRESH = 60, 12
SECONDS = 8.0
START = """() => {
  const times = []; const tasks = [];
  const observer = new PerformanceObserver((list) => { for (const entry of list.getEntries()) tasks.push(entry.duration); });
  observer.observe({ entryTypes: ["longtask"] });
  let last = performance.now();
  const tick = (now) => { times.push(now - last); last = now; window.measuring.next = requestAnimationFrame(tick); };
  window.measuring = { times, tasks, observer, next: requestAnimationFrame(tick) };
}"""  # noqa: E501
STOP = """() => {
  cancelAnimationFrame(window.measuring.next);
  window.measuring.observer.disconnect();
  return { times: window.measuring.times, tasks: window.measuring.tasks };
}"""
WAIT_SHOWN = """(time) => new Promise((resolve) => {
  const root = document.documentElement;
  const check = () => { if (root.dataset.shown === time) { observer.disconnect(); resolve(Date.now() / 1000); } };
  const observer = new MutationObserver(check);
  observer.observe(root, { attributes: true });
  check();
})"""


def share(values: Sequence[float], part: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(part * len(ordered)))]


class Meter:
    """The processor time of the page's main thread."""

    def __init__(self, page: Page) -> None:
        self._session = page.context.new_cdp_session(page)
        self._session.send("Performance.enable", {"timeDomain": "threadTicks"})

    def used_s(self) -> float:
        metrics = self._session.send("Performance.getMetrics")["metrics"]
        return float(next(metric["value"] for metric in metrics if metric["name"] == "TaskDuration"))


def row_of(what: str, times_ms: Sequence[float], cpu: str, longest_task_ms: float | None) -> dict[str, Any]:
    return {
        "what": what,
        "median_ms": round(statistics.median(times_ms), 1),
        "p95_ms": round(share(times_ms, 0.95), 1),
        "longest_ms": round(max(times_ms), 1),
        "longest_task_ms": longest_task_ms,
        "cpu": cpu,
    }


def measured(page: Page, meter: Meter, what: str, act: Callable[[], None]) -> dict[str, Any]:
    page.evaluate(START)
    began, used_s = time.monotonic(), meter.used_s()
    while time.monotonic() < began + SECONDS:
        act()
    busy = (meter.used_s() - used_s) / (time.monotonic() - began)
    found = page.evaluate(STOP)
    return row_of(what, found["times"][2:], f"{busy:.0%}", round(max(found["tasks"], default=0.0), 1))


def fresh(server: Served, page: Page, meter: Meter, run: Iterator[Frame]) -> dict[str, Any]:
    """From the end of `append` to the frame on the page."""
    delays_ms = []
    used_s = 0.0
    for _ in range(FRESH):
        frame = next(run)
        time.sleep(0.3)
        before_s = meter.used_s()
        server.store.append(frame)
        began = time.time()
        server.feed.notify()
        shown = page.evaluate(WAIT_SHOWN, json.dumps(frame.time_s).removesuffix(".0"))
        delays_ms.append(1000 * max(0.0, shown - began))
        used_s += meter.used_s() - before_s
    return row_of("fresh data", delays_ms, f"{1000 * used_s / FRESH:.0f} ms", None)


def measure(radios: int, robots: int) -> list[dict[str, Any]]:
    run = TunnelRun(robots, radios, round(time.time()) - 5.0 * PAST, with_positions=False).frames(PAST + FRESH + 4)
    settings = PageSettings("tunnel", "0", topic_classes=TOPIC_CLASSES)
    with (
        tempfile.TemporaryDirectory() as directory,
        chromium() as browser,
        FrameStore.open(Path(directory) / "history.sqlite", 1e9, 1 << 30) as store,
    ):
        for _ in range(PAST):
            store.append(next(run))
        with served(store, settings) as server, opened(browser, server.url, width=1920, height=1080) as page:
            meter = Meter(page)
            page.click("#tab-radios")
            page.wait_for_timeout(1500)
            rows = [fresh(server, page, meter, run)]

            def pan() -> None:
                page.mouse.move(500, 500)
                page.mouse.down()
                page.mouse.move(560, 520, steps=6)
                page.mouse.up()
                page.mouse.wheel(0, -100)
                page.mouse.wheel(0, 100)

            rows.append(measured(page, meter, "pan and zoom", pan))
            span = store.span()
            assert span is not None
            page.locator("#slider").fill(str(span[0]))
            page.select_option("#speed", "10")
            page.click("#play")
            rows.append(measured(page, meter, "play at 10x", lambda: page.wait_for_timeout(200)))
    return [{"radios": radios, "robots": robots, **row, **this_machine()} for row in rows]


def table(rows: Sequence[dict[str, Any]]) -> str:
    lines = ["| radios | robots | what | median | 95 % | longest | longest task | CPU |", "|" + " --- |" * 8]
    for row in rows:
        task = "" if row["longest_task_ms"] is None else f"{row['longest_task_ms']:.0f} ms"
        times = " | ".join(f"{row[key]:.0f} ms" for key in ("median_ms", "p95_ms", "longest_ms"))
        lines.append(f"| {row['radios']} | {row['robots']} | {row['what']} | {times} | {task} | {row['cpu']} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.monitor_page", description=__doc__)
    parser.add_argument("--radios", type=int, default=200)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    rows = measure(arguments.radios, arguments.robots)
    RESULTS.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print(table(rows))
    if arguments.fill:
        fill("monitor-page", table(rows))


if __name__ == "__main__":
    main()
