"""The page in a real browser: hostile and missing facts, time, keyboard, lost connections, one file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from benchmarks.monitor_fleet import TOPIC_CLASSES, TunnelRun
from meshctl.monitor.frame import Frame
from meshctl.monitor.page import recording_of, save_page
from meshctl.monitor.server import PageSettings
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.monitor.browser import PATIENCE_MS, file_url, opened
from tests.meshctl.monitor.recordings import OFFLINE_S, write_recording
from tests.meshctl.monitor.served import served
from udp_mesh.report import main as report

pytestmark = pytest.mark.xdist_group("browser")

SETTINGS = PageSettings("tunnel", "0", topic_classes=TOPIC_CLASSES)
START_S = 1_790_000_000.0
FRAMES = 60
# in every text that a device reports
HOSTILE = "<img src=x onerror=\"document.title='owned'\"><script>document.title='owned'</script>"


@pytest.fixture(autouse=True)
def patience() -> None:
    expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(TunnelRun(3, 14, START_S).frames(FRAMES))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[FrameStore]:
    with FrameStore.open(tmp_path / "history.sqlite", 1e9, MIN_BYTES) as made:
        yield made


def shown_s(page: Page) -> float:
    return float(page.locator("html").get_attribute("data-shown") or "nan")


def facts_of(part: Locator) -> dict[str, str]:
    """The facts in a card, by term."""
    terms, values = part.locator(".facts dt").all_text_contents(), part.locator(".facts dd").all_text_contents()
    return dict(zip(terms, values, strict=True))


def changed(frame: Frame, change: Any) -> Frame:
    """The frame with `change(key, value)` in place of every text and number of its status."""

    def walk(key: str, value: Any) -> Any:
        if isinstance(value, dict):
            return {name: walk(name, item) for name, item in value.items()}
        if isinstance(value, list):
            return [walk(key, item) for item in value]
        return change(key, value)

    document = frame.document
    return Frame.of({**document, "status": walk("", document["status"]), "links": walk("", document["links"])})


def test_hostile_names_and_texts_never_become_markup(browser: Browser, store: FrameStore, frames: list[Frame]) -> None:
    kept = ("health", "role", "state", "level", "time_s")
    names: dict[str, str] = {}

    def hostile(key: str, value: Any) -> Any:
        return (
            names.setdefault(value, f"{HOSTILE}{len(names)}") if isinstance(value, str) and key not in kept else value
        )

    frame = changed(frames[30], hostile)
    store.append(
        Frame.of({**frame.document, "fleet": HOSTILE, "verdict": {"go": False, "text": HOSTILE, "reasons": [HOSTILE]}})
    )
    with served(store, SETTINGS) as server, opened(browser, server.url, width=1600) as page:
        for tab in ("alarms", "radios", "changes"):
            page.click(f"#tab-{tab}")
        page.click("#tab-radios")
        page.locator("#radios tbody tr").first.click()
        expect(page.locator("#details h2").first).to_contain_text("<img src=x")
        expect(page.locator("#reasons")).to_have_text(HOSTILE)
        expect(page.locator("#fleet")).to_have_text(HOSTILE)
        page.hover("#mesh", position={"x": 400, "y": 300})
        assert page.locator("img, iframe, object, script:not([src])").count() == 0
        assert "owned" not in page.title().replace(HOSTILE, "")


def test_what_is_not_known_is_shown_as_missing_and_never_as_zero(
    browser: Browser, store: FrameStore, frames: list[Frame]
) -> None:
    kept = ("hops", "time_s", "messages", "priority", "age_s", "error", "warning", "note")

    def unknown(key: str, value: Any) -> Any:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return None if number and key not in kept else value

    store.append(Frame.of({**changed(frames[30], unknown).document, "radios": {}, "airtime": None, "verdict": None}))
    with served(store, SETTINGS) as server, opened(browser, server.url, width=1600) as page:
        expect(page.locator("#verdict")).to_contain_text("NOT ASSESSED")
        facts = facts_of(page.locator("#robots article").nth(1))
        for name in ("round trip", "capacity", "telemetry", "artifact", "loss"):
            assert facts[name] == "–", facts
        page.click("#tab-radios")
        cells = page.locator("#radios tbody tr").first.locator("td.number").all_text_contents()
        assert cells[1:4] == ["–", "–", "–"]
        page.locator("#radios tbody tr").first.click()
        details = page.locator("#details dl").first
        values = dict(
            zip(details.locator("dt").all_text_contents(), details.locator("dd").all_text_contents(), strict=True)
        )
        for name in ("noise", "busy", "queue", "temp.", "path", "power"):
            assert values[name] == "–", values
        expect(page.locator("#totals")).to_contain_text("– air")


def test_readings_of_the_placement_meter_are_shown_live_and_in_the_past(
    browser: Browser, store: FrameStore, frames: list[Frame]
) -> None:
    reading = {"advice": "DROP SOON", "meters_left": 12.9, "margin_db": None, "reason": "weak next hop"}
    store.append(Frame.of({**frames[0].document, "meters": {"spot1": reading}}))
    store.append(frames[1])
    with served(store, SETTINGS) as server, opened(browser, server.url, width=1600) as page:
        meter = page.locator("#robots .meter")
        expect(meter).to_have_count(0)
        page.keyboard.press("ArrowLeft")
        expect(meter).to_contain_text("DROP SOON")
        expect(meter.locator("b")).to_have_text(["12", "–"])
        expect(meter).to_contain_text("weak next hop")


def test_readings_of_a_running_placement_meter_arrive_between_frames_and_go_when_it_ends(
    browser: Browser, store: FrameStore, frames: list[Frame]
) -> None:
    readings: dict[str, Mapping[str, Any]] = {}
    store.append(frames[0])
    with (
        served(store, SETTINGS, meters=lambda: dict(readings)) as server,
        opened(browser, server.url, width=1600) as page,
    ):
        meter = page.locator("#robots .meter")
        for advice, left in (("GO", 31.4), ("DROP NOW", 0.9), ("TURN BACK", None)):
            readings["spot1"] = {"advice": advice, "meters_left": left, "margin_db": 6.2, "reason": HOSTILE}
            server.feed.notify()
            expect(meter).to_have_attribute("data-advice", advice)
            expect(meter.locator("b")).to_have_text(["–" if left is None else str(int(left)), "6"])
        assert page.locator("img").count() == 0
        # no frame came meanwhile
        assert shown_s(page) == frames[0].time_s
        readings.clear()
        server.feed.notify()
        expect(meter).to_have_count(0)


def test_the_slider_shows_any_moment_and_alarms_lead_to_theirs(
    browser: Browser, store: FrameStore, frames: list[Frame]
) -> None:
    for frame in frames[:32]:
        store.append(frame)
    # b02 has lost its power since here
    dark = next(i for i, one in enumerate(frames) if any(n["health"] == "unreachable" for n in one.status["nodes"]))
    with served(store, SETTINGS, clock=lambda: frames[31].time_s) as server, opened(browser, server.url) as page:
        assert shown_s(page) == frames[31].time_s
        expect(page.locator("#verdict")).to_have_attribute("data-go", "false")
        page.click("#tab-alarms")
        alarm = page.locator("#alarms article", has_text="b02").first
        expect(alarm).to_contain_text("no answer")
        alarm.get_by_role("button", name="Silence").click()
        expect(page.get_by_role("button", name="Silence", exact=True)).to_be_disabled()
        page.get_by_label("Reason").fill("in repair")
        page.get_by_role("button", name="Silence", exact=True).click()
        expect(page.locator("#alarms")).to_contain_text("in repair")
        alarm.get_by_role("button", name="Jump to start").click()
        page.wait_for_selector(f'html[data-shown="{frames[dark].time_s:.0f}"]', state="attached")
        expect(page.locator("#mode")).to_contain_text("past")
        # one step earlier all was well, and the alarm is not there yet
        page.keyboard.press("ArrowLeft")
        expect(page.locator("#verdict")).to_have_attribute("data-go", "true")
        expect(page.locator("#alarms article", has_text="b02")).to_have_count(0)
        page.locator("#slider").fill(str(frames[3].time_s + 1))
        page.wait_for_selector(f'html[data-shown="{frames[3].time_s:.0f}"]', state="attached")
        # what arrives meanwhile does not disturb, and is shown live
        server.append(frames[32])
        page.keyboard.press("l")
        page.wait_for_selector(f'html[data-shown="{frames[32].time_s:.0f}"]', state="attached")
        expect(page.locator("#mode")).to_contain_text("live")
        # playing from a moment reaches the present
        page.locator("#slider").fill(str(frames[30].time_s))
        page.select_option("#speed", "60")
        page.click("#play")
        page.wait_for_selector(f'html[data-shown="{frames[32].time_s:.0f}"]', state="attached")


def test_changes_since_a_reference_state(browser: Browser, store: FrameStore, frames: list[Frame]) -> None:
    for frame in frames[:20]:
        store.append(frame)
    with served(store, SETTINGS) as server, opened(browser, server.url) as page:
        page.keyboard.press("r")
        expect(page.locator("#changes")).to_contain_text("Nothing changed")
        for frame in frames[20:35]:
            server.append(frame)
        expect(page.locator("#changes")).to_contain_text("b02: ok → unreachable")
        expect(page.locator("#changes .change[data-kind=worse]").first).to_be_visible()
        expect(page.locator("#tab-changes .count")).to_be_visible()
        # a reload keeps it
        page.reload()
        page.click("#tab-changes")
        expect(page.locator("#changes")).to_contain_text("b02: ok → unreachable")
        page.keyboard.press("r")
        expect(page.locator("#changes")).to_contain_text("No reference yet")


def test_a_page_that_was_away_says_so_and_catches_up(browser: Browser, store: FrameStore, frames: list[Frame]) -> None:
    store.append(frames[0])
    with served(store, SETTINGS) as server, opened(browser, server.url) as page:
        server.append(frames[1])
        page.wait_for_selector(f'html[data-shown="{frames[1].time_s:.0f}"]', state="attached")
        server.feed.close()
        expect(page.locator("#mode")).to_contain_text("no connection")
        expect(page.locator("#notice")).to_contain_text("No connection to the monitor since")
        server.feed.is_closed = False
        for frame in frames[2:9]:
            store.append(frame)
        page.wait_for_selector(f'html[data-shown="{frames[8].time_s:.0f}"]', state="attached")
        expect(page.locator("#notice")).to_be_hidden()
        expect(page.locator("#mode")).to_contain_text("live")


def test_all_of_the_page_works_by_keyboard_and_has_names(
    browser: Browser, store: FrameStore, frames: list[Frame]
) -> None:
    for frame in frames[:35]:
        store.append(frame)
    with served(store, SETTINGS) as server, opened(browser, server.url) as page:
        page.focus("#mesh")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        expect(page.locator("#details h2").first).not_to_be_empty()
        page.keyboard.press("Escape")
        for number, panel in enumerate(("robots", "alarms", "radios", "changes", "details"), 1):
            page.keyboard.press(str(number))
            expect(page.locator(f"#{panel}")).to_be_visible()
            expect(page.locator(f"#tab-{panel}")).to_have_attribute("aria-selected", "true")
        page.keyboard.press("n")
        assert page.evaluate("() => document.activeElement.closest('article.alarm') !== null")
        page.keyboard.press("m")
        expect(page.locator("#by-hops")).to_have_attribute("aria-pressed", "true")
        page.keyboard.press("?")
        expect(page.locator("#keys")).to_be_visible()
        page.keyboard.press("Escape")
        page.keyboard.press("s")
        expect(page.locator("#sound")).to_have_attribute("aria-pressed", "true")
        page.keyboard.press("t")
        expect(page.locator("html")).to_have_attribute("data-theme", "light")
        expect(page.locator("#mesh")).to_have_attribute("aria-label", re.compile("Mesh at .* devices, .* links"))
        unnamed = page.evaluate(
            "() => [...document.querySelectorAll('button, select, input, canvas:not([aria-hidden])')]"
            ".filter((e) => !(e.textContent.trim() || e.getAttribute('aria-label') || e.labels?.length))"
            ".map((e) => e.outerHTML)"
        )
        assert unnamed == []


def test_a_recording_is_one_file_that_needs_no_server(
    browser: Browser, store: FrameStore, frames: list[Frame], tmp_path: Path
) -> None:
    for frame in frames:
        store.append(frame)
    file = tmp_path / "run.html"
    save_page(recording_of(store, SETTINGS.as_json()), file, tmp_path)
    with opened(browser, file_url(file)) as page:
        assert shown_s(page) == frames[0].time_s
        expect(page.locator("#mode")).to_contain_text("recording")
        page.locator("#slider").fill(str(frames[30].time_s))
        page.wait_for_selector(f'html[data-shown="{frames[30].time_s:.0f}"]', state="attached")
        page.keyboard.press("3")
        page.locator("#radios tbody tr", has_text="spot1").click()
        # charts with a legend that follows the pointer
        chart = page.locator("#details .chart", has_text="Signal to noise")
        chart.locator(".u-over").hover()
        expect(chart.locator(".u-legend")).to_contain_text(re.compile(r"\d\d:\d\d:\d\d"))
        page.click("#live")
        page.wait_for_selector(f'html[data-shown="{frames[-1].time_s:.0f}"]', state="attached")
        assert page.get_by_role("button", name="Acknowledge").count() == 0
        # the frames are in several parts, and nothing of udp-mesh is there to report
        assert page.locator("script.frames").count() > 1
        expect(page.locator("#tab-report")).to_be_hidden()


def left_edge(chart: Locator) -> str:
    """The time at the left edge of a chart, from its legend."""
    chart.locator(".u-over").hover(position={"x": 2, "y": 40})
    expect(chart.locator(".u-legend")).to_contain_text(re.compile(r"\d\d:\d\d:\d\d"))
    return chart.locator(".u-legend .u-value").first.text_content() or ""


def test_the_report_of_recordings_is_the_same_page(
    browser: Browser, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [write_recording(tmp_path / f"{node}.jsonl", node, HOSTILE) for node in ("base", "spot1")]
    out = tmp_path / "run.html"
    assert report([*map(str, files), "--out", str(out), "--title", HOSTILE]) == 0
    assert capsys.readouterr().err == ""
    with opened(browser, file_url(out), width=1600) as page:
        expect(page.locator("#fleet")).to_have_text(HOSTILE)
        expect(page.locator("#mode")).to_contain_text("recording")
        panel = page.locator("#report")
        for title in ("Throughput by topic", "Throughput by priority", "Latency", "Round-trip", "Outbox", "Online"):
            expect(panel.locator(".chart h3", has_text=title).first).to_be_visible()
        expect(panel.locator("table").first).to_contain_text(f"map{HOSTILE}")
        expect(panel).to_contain_text("tables and charts count every line")
        expect(page.locator("#legend")).to_contain_text("track, online")
        # hover shows the values of that time
        chart = panel.locator(".chart", has_text="Throughput by topic")
        whole = left_edge(chart)
        area = chart.locator(".u-over")
        area.drag_to(area, source_position={"x": 150, "y": 40}, target_position={"x": 250, "y": 40})
        assert left_edge(chart) > whole
        # all charts are zoomed together
        assert left_edge(panel.locator(".chart", has_text="Loss to the peer")) > whole
        area.dblclick()
        assert left_edge(chart) == whole
        # an event leads to its moment, and the slider to any other
        event = panel.locator("li", has_text="peer-offline").first
        event.locator("button").click()
        page.wait_for_selector(f'html[data-shown="{OFFLINE_S:.0f}"]', state="attached")
        page.locator("#slider").fill(str(OFFLINE_S - 10))
        page.wait_for_selector(f'html[data-shown="{OFFLINE_S - 10:.0f}"]', state="attached")
        card = page.locator("#robots article", has_text="spot1")
        expect(card).to_contain_text("ok")
        # instead of go or no-go, which no recording has: whom the base had then
        expect(page.locator("#verdict")).to_have_text("3/3 with the base")
        expect(page.locator("#totals")).to_have_text("robots recorded2/4")
        page.locator("#slider").fill(str(OFFLINE_S + 5))
        expect(page.locator("#verdict")).to_have_text("0/3 with the base")
        expect(page.locator("#reasons")).to_contain_text(f"Out of its reach: husky1, spot1, stranger{HOSTILE}")
        # the other recording
        panel.locator("select").select_option(label="recorded by spot1")
        expect(panel.locator(".chart").first).to_be_visible()
        page.keyboard.press("Escape")
        page.keyboard.press("3")
        page.keyboard.press("6")
        expect(panel).to_be_visible()
        assert page.locator("img, iframe, object").count() == 0
        assert "owned" not in page.title().replace(HOSTILE, "")
