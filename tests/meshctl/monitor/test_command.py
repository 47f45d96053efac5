"""`meshctl monitor` as its users run it: a virtual fleet breaks and recovers, and a real browser shows the page."""

from __future__ import annotations

import base64
import gzip
import json
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from typer.testing import CliRunner

from meshctl.cli.main import build
from meshctl.cli.monitor_web import WebOptions
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.monitor.browser import PATIENCE_MS, file_url, opened
from tests.meshctl.monitor.documents import frame
from tests.meshctl.monitor.recordings import write_recording
from tests.meshctl.status.fleets import trio
from tests.meshctl.status.line_fleet import Bench, line_of_three

pytestmark = pytest.mark.xdist_group("browser")


@contextmanager
def monitoring(bench: Bench, *words: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The address of the page, and the process."""
    command = bench.command("monitor", "--interval", "1", "--port", "0", "--timeout", "20", "--json", *words)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=bench.environ) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["url"], process
        finally:
            process.kill()


@pytest.mark.lab
def test_the_page_follows_a_fleet_that_breaks_and_recovers(browser: Browser, tmp_path: Path) -> None:
    expect.set_options(timeout=PATIENCE_MS)
    history, run = tmp_path / "run.sqlite", tmp_path / "run.html"
    with line_of_three(tmp_path) as bench:
        with (
            monitoring(bench, "--store", str(history)) as (url, process),
            opened(browser, url, width=1600) as page,
        ):
            totals = page.locator("#totals")
            expect(totals).to_contain_text("3/3")
            began = page.locator("html").get_attribute("data-shown")
            page.click("#tab-radios")
            row = page.locator("#radios tbody tr", has_text="b02")
            expect(row).to_contain_text("✓ ok")
            # a node dies
            bench.fleet.inject_fault("b02", "off")
            expect(row).to_contain_text("✕ no answer")
            expect(page.locator("#verdict")).to_have_attribute("data-go", "false")
            page.click("#tab-alarms")
            alarm = page.locator("#alarms article", has_text="unreachable")
            expect(alarm).to_contain_text("b02")
            alarm.get_by_role("button", name="Acknowledge").click()
            expect(page.locator("#alarms article.is-acknowledged")).to_contain_text("acknowledged by")
            # back in time it still answers
            page.locator("#slider").fill(str(began))
            expect(totals).to_contain_text("3/3")
            expect(page.locator("#mode")).to_contain_text("past")
            page.keyboard.press("l")
            expect(totals).to_contain_text("2/3")
            # it comes back, over a link that has become bad
            bench.fleet.repair()
            bench.fleet.link("b01", "b02", tq=90, signal_dbm=-88)
            expect(totals).to_contain_text("3/3")
            expect(page.locator("#alarms li", has_text="unreachable")).to_contain_text("b02")
            page.click("#tab-radios")
            page.locator("#radios tbody tr", has_text="b02").click()
            expect(page.locator("#details table .bar[data-class=poor]").first).to_be_visible()
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
        # the debriefing
        done = bench.run_bare("monitor", "--replay", str(history), "--out", str(run))
        assert done.exit_code == 0, done.stderr
    with opened(browser, file_url(run)) as page:
        expect(page.locator("#mode")).to_contain_text("recording")
        page.click("#live")
        expect(page.locator("#totals")).to_contain_text("3/3")


def run(*words: str) -> tuple[int, str]:
    environ: dict[str, str | None] = dict.fromkeys(("MESHCTL_INVENTORY", "MESHCTL_LAB", "MESHCTL_MONITOR_TOKEN"))
    done = CliRunner().invoke(build("monitor"), ["monitor", *words], env=environ, catch_exceptions=False)
    return done.exit_code, done.output


@pytest.fixture
def history(tmp_path: Path) -> Path:
    path = tmp_path / "run.sqlite"
    with FrameStore.open(path, 1e9, MIN_BYTES) as store:
        store.append(frame(1000.0))
    return path


def test_recordings_of_robots_are_part_of_the_debriefing(history: Path) -> None:
    recording = write_recording(history.parent / "spot1.jsonl", "spot1")
    with recording.open("a", encoding="utf-8") as file:
        file.write("cut o")
    page = history.parent / "run.html"
    code, output = run("--replay", str(history), "--replay", str(recording), "--out", str(page))
    assert code == 0
    assert f"warning: {recording}: line " in output
    (packed,) = re.findall(r'id="recording">([^<]*)<', page.read_text(encoding="utf-8"))
    document = json.loads(gzip.decompress(base64.b64decode(packed)))
    assert document["meta"]["fleet"] == "lab"
    (report,) = document["report"]
    assert report["node"] == "spot1"
    assert "Invalid lines, which were ignored: 1." in report["notes"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--listen", "example.org"], "--listen: expected an IP address, found 'example.org'"),
        (["--tls-cert", "cert.pem"], "expected --tls-cert and --tls-key together"),
        (["--out", "run.html"], "--out needs --replay"),
        (["--replay", "nothing.sqlite"], "cannot read nothing.sqlite: No such file or directory"),
        (["--replay", "run.sqlite", "--once"], "--replay does not go with --once"),
        (["--replay", "run.sqlite", "--store", "x", "--hook", "y"], "--replay does not go with --store, --hook"),
        (["--tls-cert", "nothing", "--tls-key", "run.sqlite"], "cannot use nothing and run.sqlite: No such file"),
        (["--tls-cert", "run.sqlite", "--tls-key", "run.sqlite"], "cannot use run.sqlite and run.sqlite: "),
        (["--token-file", "nothing"], "cannot read nothing: No such file or directory"),
        (["--hook", "notify 'unbalanced"], "--hook: expected a command line, found"),
        (["--hook", "cat >> alarms"], "--hook: no shell runs the command, so '>>' would be an argument"),
        (["--hook", "mail ops; date"], """hint: use a shell: --hook 'sh -c '"'"'mail ops; date"""),
        (["--webhook", "http://x:port/"], "webhook: expected an http or https URL, found 'http://x:port/'"),
        (["--hook-level", "loud"], "hook level: expected note, warning, error, found 'loud'"),
        (["--interval", "nan"], "Invalid value for '--interval'"),
        (["--keep-days", "nan"], "Invalid value for '--keep-days'"),
        (["--keep-days", "inf"], "Invalid value for '--keep-days'"),
        (["--replay", "run.sqlite", "--listen", "192.0.2.1"], "cannot listen on 192.0.2.1 port 8765"),
    ],
)
def test_wrong_options_are_named(
    words: list[str], expected: str, history: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(history.parent)
    code, output = run(*words)
    assert (code, expected in output) == (2, True), output


def test_a_history_goes_where_a_directory_can_be_made(tmp_path: Path) -> None:
    trio(tmp_path)
    (tmp_path / "file").touch()
    words = ("--once", "-i", str(tmp_path / "fleet.yaml"), "--store")
    code, output = run(*words, str(tmp_path / "file/deep/run.sqlite"))
    assert (code, f"{tmp_path}/file/deep: cannot be created: Not a directory" in output) == (2, True), output
    # nothing answers, which is an answer
    code, output = run(*words, str(tmp_path / "new/run.sqlite"), "--timeout", "0.5", "--no-robots")
    assert (tmp_path / "new/run.sqlite").is_file(), output
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o700


def test_a_single_snapshot_reports_its_new_alarms_to_hook_and_textfile(tmp_path: Path) -> None:
    trio(tmp_path)
    script = tmp_path / "hook"
    script.write_text(f"#!/bin/sh\nsleep 1\necho $MESHCTL_ALARM_DEVICE >>{tmp_path}/reported\n")
    script.chmod(0o755)
    words = ["--once", "-i", str(tmp_path / "fleet.yaml"), "--store", str(tmp_path / "run.sqlite"), "--no-robots"]
    words += ["--timeout", "0.5", "--hook", str(script), "--textfile", str(tmp_path / "fleet.prom")]
    _, output = run(*words)
    assert sorted((tmp_path / "reported").read_text().split()) == ["b01", "base", "rover"], output
    assert "meshctl_alarm" in (tmp_path / "fleet.prom").read_text()
    # the alarms continue: the next one has nothing to report
    run(*words)
    assert len((tmp_path / "reported").read_text().split()) == 3


def test_a_history_from_the_future_is_warned_of(tmp_path: Path) -> None:
    trio(tmp_path)
    path = tmp_path / "run.sqlite"
    words = ("--once", "-i", str(tmp_path / "fleet.yaml"), "--store", str(path), "--no-robots", "--timeout", "0.5")
    _, output = run(*words)
    assert "ahead of this machine's clock" not in output
    with FrameStore.open(path, 1e9, MIN_BYTES) as store:
        # the laptop's clock was two days ahead
        store.append(frame(time.time() + 2 * 86400))
    _, output = run(*words)
    assert f"warning: {path}: its newest snapshot is 48 h ahead of this machine's clock" in output


@pytest.mark.parametrize("token", ["", "short", "with a space in it, which is long"])
def test_a_weak_token_is_refused(token: str, tmp_path: Path) -> None:
    (tmp_path / "token").write_text(token)
    code, output = run("--token-file", str(tmp_path / "token"))
    assert (code, "expected a token of at least 16 printable ASCII characters" in output) == (2, True), output


def test_actions_need_a_token_everywhere() -> None:
    def token(host: str, *, allow_actions: bool) -> str:
        return WebOptions.checked(host, 0, None, None, None, (), allow_actions=allow_actions).token

    assert token("127.0.0.1", allow_actions=False) == ""
    made = {
        token("127.0.0.1", allow_actions=True),
        token("::1", allow_actions=True),
        token("0.0.0.0", allow_actions=False),
    }
    assert len(made) == 3
    assert min(map(len, made)) >= 24


def test_a_history_becomes_one_file(history: Path, tmp_path: Path) -> None:
    code, output = run("--replay", str(history), "--out", str(tmp_path / "run.html"), "--json")
    written = json.loads(output)
    assert (code, written["event"]) == (0, "written")
    assert (tmp_path / "run.html").stat().st_size == written["bytes"]
