"""`meshctl alarms` and `meshctl metrics` on the history of a monitor."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest

from meshctl.cli.main import main
from meshctl.cli.monitor_history import history_path
from meshctl.monitor.prometheus import TextfileWriter
from meshctl.monitor.store import MIN_BYTES, FrameStore
from tests.meshctl.monitor.documents import frame
from tests.meshctl.status.fleets import trio

RAISED = {("b01", "weak"): "warning", ("robot:rover", "disk"): "error", ("", "not-compared"): "note"}


@pytest.fixture
def inventory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A fleet whose monitor has seen alarms, one of which ended."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    trio(tmp_path)
    path = history_path("trio", None)
    now_s = time.time()
    with FrameStore.open(path, 1e6, MIN_BYTES) as store:
        store.append(frame(now_s - 600, {**RAISED, ("b02", "clock"): "note"}))
        store.append(frame(now_s - 300, RAISED))
    return str(tmp_path / "fleet.yaml")


def said(capfd: pytest.CaptureFixture[str], *words: str, code: int = 0) -> str:
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    out, err = capfd.readouterr()
    assert ended.value.code == code, out + err
    return out if code != 2 else err


def test_alarms_are_listed_acknowledged_and_silenced(inventory: str, capfd: pytest.CaptureFixture[str]) -> None:
    lines = said(capfd, "alarms", "list", "-i", inventory, code=1).splitlines()
    assert [re.sub(r"\d+ min", "MINUTES", line) for line in lines] == [
        "error: robot:rover disk: disk of robot:rover (since MINUTES)",
        "  look",
        "warning: b01 weak: weak of b01 (since MINUTES)",
        "  look",
        "note: fleet not-compared: not-compared of  (since MINUTES)",
        "  look",
        "last snapshot MINUTES ago",
    ]
    everything = said(capfd, "alarms", "list", "--all", "-i", inventory, code=1)
    assert re.search(r"note: b02 clock: clock of b02 \(ended \d+ min ago, after 5 min\)", everything)
    said(capfd, "alarms", "ack", "robot:rover", "disk", "--by", "alice", "-i", inventory)
    silence = ("silence", "b01", "*", "--for", "2h", "--reason", "on the bench", "--by", "bob")
    said(capfd, "alarms", *silence, "-i", inventory)
    text = said(capfd, "alarms", "list", "-i", inventory)
    assert re.search(r"\n  acknowledged by alice \d+ s ago\n", text)
    assert re.search(r"\n  silenced by bob for another (120 min|2.0 h): on the bench\n", text)
    document = json.loads(said(capfd, "alarms", "list", "--json", "-i", inventory))
    assert [(one["device"], one["acknowledged"] is not None) for one in document] == [
        ("robot:rover", True),
        ("b01", False),
        ("", False),
    ]
    said(capfd, "alarms", "unsilence", "b01", "*", "-i", inventory)
    assert "silenced" not in said(capfd, "alarms", "list", "-i", inventory, code=1)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("ack", "b01", "clock"), "b01 has no open alarm clock"),
        (("ack", "b01", "weeak"), "unknown alarm code 'weeak'"),
        (("ack", "b1", "weak"), "b1 has no open alarm weak"),
        (("silence", "b01", "weak", "--reason", " "), "expected a reason"),
        (("silence", "b01", "weak", "--reason", "x", "--for", "soon"), "expected a time such as 30m"),
        (("silence", "b01", "weak", "--reason", "x", "--for", "0h"), "expected a time such as 30m"),
        (("unsilence", "b01", "weak"), "b01 has no silence of weak"),
        (("list", "--store", "/nonexistent/history"), "no history"),
    ],
)
def test_wrong_input_is_explained(
    inventory: str, capfd: pytest.CaptureFixture[str], words: tuple[str, ...], message: str
) -> None:
    assert message in said(capfd, "alarms", *words, "-i", inventory, code=2)


def test_metrics_of_a_history_and_the_files_for_prometheus(
    inventory: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    store = str(history_path("trio", None))
    said(capfd, "alarms", "silence", "b01", "weak", "--reason", "known", "--store", store)
    page = said(capfd, "metrics", "--store", store)
    assert 'meshctl_alarm{device="b01",code="weak",level="warning",acknowledged="false",silenced="true"} 1\n' in page
    assert 'meshctl_node_up{node="b01",role="",state=""} 1\n' in page
    out = tmp_path / "meshctl.prom"
    said(capfd, "metrics", "--store", store, "--textfile", str(out))
    assert out.read_text() == page
    assert out.stat().st_mode & 0o777 == 0o644
    assert [file.name for file in tmp_path.glob("*meshctl.prom*")] == ["meshctl.prom"]
    with FrameStore.open_running(history_path("trio", None)) as running:
        newest = running.latest()
        assert newest is not None
        writer = TextfileWriter(tmp_path / "no" / "x.prom", running)
        writer(newest, ())
        assert "cannot be written" in writer.problem
        writer.path = out
        writer(newest, ())
        assert (writer.problem, out.read_text()) == ("", page)
    assert "groups:" in said(capfd, "metrics", "--rules")
    assert json.loads(said(capfd, "metrics", "--dashboard"))["uid"] == "meshctl-fleet"
    assert json.loads(said(capfd, "metrics", "--file-sd", "-i", inventory)) == []
    assert "cannot be written" in said(
        capfd, "metrics", "--store", store, "--textfile", str(tmp_path / "no" / "x.prom"), code=2
    )
    assert "expected one of" in said(capfd, "metrics", "--rules", "--dashboard", code=2)
    for command in ("metrics", "monitor"):
        text = said(capfd, command, "-i", inventory, "--textfile", str(tmp_path / "fleet.txt"), code=2)
        assert "expected a file name that ends in .prom" in text
        assert not (tmp_path / "fleet.txt").exists()


def test_targets_name_the_robots_that_are_none_on_standard_error(
    inventory: str, capfd: pytest.CaptureFixture[str]
) -> None:
    text = Path(inventory).read_text().replace("10.42.0.15/24", "172.42.0.14/24")
    Path(inventory).write_text(f"{text}udp_mesh: {{metrics_port: 9871}}\n")
    with pytest.raises(SystemExit) as ended:
        main(["metrics", "--file-sd", "-i", inventory])
    out, err = capfd.readouterr()
    assert ended.value.code == 0
    assert [group["labels"]["robot"] for group in json.loads(out)] == ["station", "rover"]
    assert err == "shelf is no target: 127.42.0.14:9871 is that of rover\n"
