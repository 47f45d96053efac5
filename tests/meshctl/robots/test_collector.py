"""The collector: its sessions with radios, its pauses, its configuration, and what it tells the daemon."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from meshctl.device.link_table import LinkTable, answering_script
from meshctl.device.observation import Originator
from meshctl.robots import radio_session
from meshctl.robots.collector import (
    MAX_BACKOFF_S,
    MAX_PAUSE_S,
    NAMES_EVERY_S,
    Configuration,
    ConfigurationError,
    LinkCollector,
    RadioPoller,
    load,
    main,
    pause_s,
    run,
)
from meshctl.robots.local_daemon import LocalDaemon
from meshctl.robots.radio_session import OwnRadio, RadioError, RadioLogin, RadioSession, ssh_command
from tests.waiting import until

BASE_MAC = "02:00:00:00:00:01"
# a radio that hears the base
IW = f"""
iw() {{
    case "$*" in
    dev) printf 'Interface mesh0\\ntype mesh point\\n' ;;
    *station*) printf 'Station {BASE_MAC} (on mesh0)\\n\\tsignal:  \\t-63 dBm\\n' ;;
    esac
}}
"""
DOCUMENT: dict[str, Any] = {
    "version": 1,
    "robot": "husky1",
    "radios": [{"name": "husky1-front", "host": "10.42.0.11", "port": 22, "user": "root"}],
    "robots": {"base": ["base"]},
    "key": "/var/lib/udp-mesh/collector/id_ed25519",
    "known_hosts": "collector_known_hosts",
    "names": "../../../radio-names.json",
    "macs": {BASE_MAC.upper(): "base"},
    "load_mbit_s": 2.0,
}


@dataclass
class Daemon:
    """A daemon that keeps the reports it gets, and refuses requests with `code` if that is set."""

    path: Path
    reports: list[dict[str, Any]] = field(default_factory=list)
    code: str = ""

    def serve(self) -> Callable[[], None]:
        server = socket.socket(socket.AF_UNIX)
        server.bind(str(self.path))
        server.listen()

        def work() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection:
                    while len(lengths := connection.recv(8, socket.MSG_WAITALL)) == 8:
                        header_bytes, payload_bytes = struct.unpack(">II", lengths)
                        header = json.loads(connection.recv(header_bytes, socket.MSG_WAITALL))
                        self.reports.append(json.loads(connection.recv(payload_bytes, socket.MSG_WAITALL)))
                        answer = {"id": header["id"], "ok": not self.code, "code": self.code, "error": "found it"}
                        encoded = json.dumps(answer).encode()
                        connection.sendall(struct.pack(">II", len(encoded), 0) + encoded)

        threading.Thread(target=work, daemon=True).start()

        def close() -> None:
            server.shutdown(socket.SHUT_RDWR)
            server.close()

        return close


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    this = Daemon(tmp_path / "daemon.sock")
    close = this.serve()
    yield this
    close()


class NoSession:
    """A poller that is not started asks nothing."""

    def ask(self) -> LinkTable:
        raise AssertionError("not asked")

    def close(self) -> None:
        """Nothing is open."""


def configuration(folder: Path, **changes: object) -> Configuration:
    path = folder / "collector.json"
    path.write_text(json.dumps({**DOCUMENT, "names": "names.json", **changes}))
    return load(path)


def at(taken_s: float) -> LinkTable:
    path = (Originator(BASE_MAC, BASE_MAC, "mesh0", 100, True, 255),)
    return LinkTable(taken_s, {BASE_MAC: -60}, {BASE_MAC: -95}, paths=path)


@contextmanager
def collector(
    folder: Path, daemon: Daemon, said: list[str], **changes: object
) -> Iterator[tuple[LinkCollector, RadioPoller]]:
    settings = configuration(folder, **changes)
    poller = RadioPoller(settings.radios[0], NoSession(), settings.interval_s)
    with closing(LocalDaemon(daemon.path)) as client:
        yield LinkCollector(settings, [poller], client, said.append), poller


def test_the_daemon_gets_what_the_radio_tells_and_its_age(tmp_path: Path, daemon: Daemon) -> None:
    said: list[str] = []
    with collector(tmp_path, daemon, said) as (this, poller):
        this.step(100.0)
        poller.latest, poller.problem = at(100.5), ""
        this.step(101.0)
        this.step(102.0)
        first, second, third = daemon.reports
        assert (first["problem"], first["paths"]) == ("", [])
        assert [path["next_hop"] for path in second["paths"]] == ["base"]
        assert (second["source"], second["problem"]) == ("husky1-front", "")
        # the same table is no second sample
        assert third["paths"] == [{**second["paths"][0], "age_s": 1.5}]
        assert said == []


def test_a_radio_that_stops_answering_is_named_once_and_its_values_grow_old(tmp_path: Path, daemon: Daemon) -> None:
    said: list[str] = []
    with collector(tmp_path, daemon, said) as (this, poller):
        poller.latest, poller.problem = at(100.0), ""
        this.step(100.0)
        poller.problem = "ssh: connect to host 10.42.0.11 port 22: No route to host"
        for second in range(1, 35):
            this.step(100.0 + second)
        assert [report["paths"][0]["age_s"] for report in daemon.reports[:30]] == list(range(30))
        assert daemon.reports[-1]["paths"] == []
        problem = "husky1-front does not answer: ssh: connect to host 10.42.0.11 port 22: No route to host"
        assert daemon.reports[-1]["problem"] == problem
        poller.latest, poller.problem = at(140.0), ""
        this.step(140.0)
        assert daemon.reports[-1]["paths"][0]["age_s"] == 0.0
        assert said == [problem, "husky1-front: works again"]


def test_an_older_daemon_is_named_with_what_to_do_and_asked_again(tmp_path: Path, daemon: Daemon) -> None:
    said: list[str] = []
    with collector(tmp_path, daemon, said) as (this, poller):
        poller.latest, poller.problem = at(100.0), ""
        daemon.code = "unknown-op"
        this.step(100.0)
        this.step(101.0)
        daemon.code = ""
        this.step(102.0)
        old = "the daemon is older than this collector, and takes no radio values: run `meshctl robots deploy`"
        assert said == [old, "daemon: works again"]


def test_a_daemon_that_restarts_gets_the_next_report(tmp_path: Path) -> None:
    said: list[str] = []
    this = Daemon(tmp_path / "daemon.sock")
    with collector(tmp_path, this, said) as (beside, poller):
        poller.latest, poller.problem = at(100.0), ""
        beside.step(100.0)
        assert "No such file" in said[0]
        close = this.serve()
        beside.step(101.0)
        close()
        assert len(this.reports) == 1
        assert said[1:] == ["daemon: works again"]


def test_observed_names_are_read_again_and_survive_a_broken_file(tmp_path: Path, daemon: Daemon) -> None:
    said: list[str] = []
    with collector(tmp_path, daemon, said, macs={}) as (this, poller):
        poller.latest, poller.problem = at(0.0), ""
        this.step(0.0)
        assert daemon.reports[-1]["problem"].startswith("no radio is known by name: run `meshctl status`")
        names = tmp_path / "names.json"
        names.write_text(json.dumps({BASE_MAC.upper(): "base"}))
        this.step(NAMES_EVERY_S)
        assert [path["next_hop"] for path in daemon.reports[-1]["paths"]] == ["base"]
        names.write_text("[")
        this.step(2 * NAMES_EVERY_S)
        assert daemon.reports[-1]["paths"]
        assert said[-1].startswith(f"{names}: ")


@pytest.mark.parametrize(
    ("took_s", "failures", "paused_s"),
    [
        (0.1, 0, 0.9),
        (0.4, 0, 1.6),
        (3.0, 0, 2.0),
        (9.0, 0, 0.0),
        (5.0, 1, 1.0),
        (5.0, 3, 4.0),
        (5.0, 5000, MAX_BACKOFF_S),
    ],
)
def test_a_slow_or_silent_radio_is_asked_less_often(took_s: float, failures: int, paused_s: float) -> None:
    assert pause_s(1.0, took_s, failures) == pytest.approx(paused_s)
    assert MAX_PAUSE_S <= MAX_BACKOFF_S


def test_a_session_asks_many_times_over_one_process() -> None:
    # this shell has no radio: its answers have the last section alone
    session = RadioSession(["sh", "-c", answering_script()])
    first, second = session.ask(), session.ask()
    process = session._process
    assert process is not None
    session.close()
    assert process.returncode is not None
    assert first.signals_dbm == second.signals_dbm == {}
    assert first.taken_s <= second.taken_s


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("echo 'ssh: connect to host x: No route to host' >&2; exit 255", "ssh: connect to host x: No route to host"),
        ("exit 1", "the connection ended"),
        ("exec sleep 60", "no answer"),
        ("exec cat /dev/zero", "its answer exceeds 1024 KiB"),
    ],
)
def test_a_session_that_fails_says_why_and_begins_again(
    script: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(radio_session, "CONNECT_TIMEOUT_S", 1.0)
    monkeypatch.setattr(radio_session, "ANSWER_TIMEOUT_S", 1.0)
    session = RadioSession(["sh", "-c", script])
    for _ in range(2):
        with pytest.raises(RadioError, match=reason):
            session.ask()
        assert session._process is None


def test_a_program_that_is_missing_is_an_error_of_the_radio() -> None:
    with pytest.raises(RadioError, match="No such file"):
        RadioSession(["/nonexistent/ssh"]).ask()


def test_ssh_uses_nothing_but_what_is_deployed() -> None:
    words = ssh_command(OwnRadio("husky1-front", "fd00::1"), RadioLogin(Path("/var/lib/a key%1"), Path("/etc/known")))
    assert words[:4] == ["ssh", "-T", "-F", "none"]
    assert 'IdentityFile="/var/lib/a key%%1"' in words
    assert "HostKeyAlias=husky1-front" in words
    assert "StrictHostKeyChecking=yes" in words
    assert words[-2:] == ["fd00::1", answering_script()]


def test_pollers_run_until_the_last_report(tmp_path: Path, daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshctl.robots.collector.ssh_command", lambda *_: ["sh", "-c", IW + answering_script()])

    class Answered(Exception):
        """The radio's first answer is in a report."""

    def look(report: Mapping[str, Any]) -> None:
        assert daemon.reports[-1] == report
        assert report["problem"] == ""
        if report["neighbors"]:
            raise Answered

    with pytest.raises(Answered):
        run(configuration(tmp_path, interval_s=0.05), LocalDaemon(daemon.path), say=lambda _: None, show=look)
    until(lambda: not [one for one in threading.enumerate() if one.name == "radio-husky1-front"], "the thread's end")


def test_a_thread_that_fails_ends_the_process_which_systemd_starts_again(
    tmp_path: Path, daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("meshctl.robots.collector.RadioSession", lambda _: NoSession())
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    with pytest.raises(RuntimeError, match="the thread that asks husky1-front has ended"):
        run(configuration(tmp_path, interval_s=0.05), LocalDaemon(daemon.path), say=lambda _: None)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (None, "No such file"),
        ("{", "expected a collector's configuration"),
        ("[]", "expected a collector's configuration"),
        ('{"version": 2}', "expected version 1, found 2"),
        (json.dumps({**DOCUMENT, "radios": 3}), "expected a collector's configuration"),
        (json.dumps({key: value for key, value in DOCUMENT.items() if key != "macs"}), "expected the key 'macs'"),
    ],
)
def test_a_bad_configuration_is_one_line_with_its_file(
    text: str | None, complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "collector.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigurationError, match=complaint):
        load(path)
    assert main([str(path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"{path}: ")
    assert len(error.splitlines()) == 1
