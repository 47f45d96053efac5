"""`meshctl status`, `preflight` and `topology` as their users run them, over a virtual fleet's real SSH."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from collections.abc import Iterator

import pytest

from tests.meshctl.status.line_fleet import NAMES, Bench, line_of_three
from tests.meshctl.status.terminal import PATIENCE_S, Terminal
from tests.processes import killed_on_failure
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs")]


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with line_of_three(tmp_path_factory.mktemp("looked-at")) as bench:
        yield bench


@pytest.fixture
def bench(standing: Bench) -> Iterator[Bench]:
    """Whole again afterwards."""
    hears = {"base": {"b01"}, "b01": {"base", "b02"}, "b02": {"b01"}}

    def is_whole() -> bool:
        heard = {n["name"]: {one["name"] for one in n["neighbours"] or ()} for n in standing.status()["nodes"]}
        return heard == hears

    until(is_whole, "the line of three", wait_s=PATIENCE_S)
    yield standing
    standing.fleet.repair()
    for name in NAMES:
        standing.fleet.node(name).wait_up()


def test_a_healthy_fleet_is_reported_as_all_well_without_drift(bench: Bench) -> None:
    output = bench.status()
    assert {name: node["drift"] for name, node in output["by_name"].items()} == {name: [] for name in NAMES}
    assert (output["by_name"]["b02"]["hops"], output["by_name"]["b02"]["via"]) == (2, "b01")
    done = bench.run("status")
    assert (done.exit_code, done.stderr) == (0, "")
    assert done.stdout.startswith("looked-at: all well")
    # no packet leaves for an address that another machine may have
    assert "--lab queries only computers with ssh.host in the inventory" in " ".join(done.stdout.split())


def alarm_of(bench: Bench, name: str) -> str:
    """The text of the node's only alarm."""
    (alarm,) = bench.status()["by_name"][name]["alarms"]
    return str(alarm["text"])


def test_a_powered_off_node_is_shown_with_its_last_known_state(bench: Bench) -> None:
    bench.fleet.inject_fault("b02", "off")
    until(lambda: "no node hears it" in alarm_of(bench, "b02"), "b01 to have heard nothing of it for a while")
    output = bench.status()
    assert output["exit_code"] == 3
    last = output["by_name"]["b02"]["last_known"]
    assert (last["hops"], last["via"], last["heard"]) == (2, "b01", ["b01"])
    (alarm,) = output["by_name"]["b02"]["alarms"]
    assert alarm["code"] == "unreachable"
    assert "behind b01" in alarm["hint"]


def test_a_node_with_another_host_key_is_reported_while_the_others_are_queried(bench: Bench) -> None:
    bench.fleet.inject_fault("b01", "host-key")
    output = bench.status()
    assert [alarm["code"] for alarm in output["by_name"]["b01"]["alarms"]] == ["host-key"]
    assert output["by_name"]["base"]["answers"]
    bench.run("trust", "b01", "--replace", "--yes")
    assert bench.status()["by_name"]["b01"]["answers"]


def test_filters_limit_the_output_and_only_limits_the_queries(bench: Bench) -> None:
    assert set(bench.status("--role", "beacon")["by_name"]) == {"b01", "b02"}
    only = bench.status("b02", "--only")
    assert (set(only["by_name"]), only["by_name"]["b02"]["hops"]) == ({"b02"}, None)


def test_status_works_without_the_secrets(bench: Bench) -> None:
    output = bench.status(inventory="secret.yaml")
    assert all(node["answers"] and node["drift"] is None for node in output["nodes"])
    (alarm,) = [alarm for alarm in output["alarms"] if alarm["code"] == "not-compared"]
    assert "NOT_SET_HERE" in alarm["text"]


def test_preflight_is_go_for_a_healthy_fleet_and_no_go_for_a_broken_one(bench: Bench) -> None:
    output = bench.run("preflight").stdout
    assert output.splitlines()[-1] == "GO (radios only)", output
    bench.fleet.inject_fault("base", "off")
    done = bench.run("preflight", "--json")
    broken = json.loads(done.stdout)
    assert (done.exit_code, broken["go"]) == (1, False)
    assert "base does not answer" in next(check["reason"] for check in broken["checks"] if check["check"] == "base")


def test_topology_draws_a_line_mesh(bench: Bench) -> None:
    done = bench.run("topology")
    assert done.exit_code == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()[:3]] == ["base", "`-", "`-"]
    assert json.loads(bench.run("topology", "--json").stdout)["entry"] == "base"


def test_an_interrupt_need_not_wait_for_unreachable_devices(bench: Bench) -> None:
    bench.fleet.inject_fault("b01", "ssh-hang")
    with (
        subprocess.Popen(
            bench.command("status", "--timeout", "3600", "--watch", "1", "--json"),
            env=bench.environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
        killed_on_failure(process),
    ):
        journal = bench.directory / "state/meshctl/journal.sqlite-wal"
        until(lambda: journal.exists() or process.poll() is not None, "the look to begin", wait_s=PATIENCE_S)
        process.send_signal(signal.SIGINT)
        _, output = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, output.splitlines()[-1:]) == (130, ["interrupted"])


def test_watch_follows_the_window_size_and_restores_the_screen(bench: Bench) -> None:
    watch = bench.command("status", "--watch", "1", "--timeout", "60")
    with Terminal(watch, bench.environ, lines=60, columns=160) as terminal:
        shown = terminal.shows("looked-at: .*all well.*Ctrl-C to quit", "a page")
        assert "disk free" in shown
        # a count of answers would stand in the page
        assert not re.search(r"queried \d+ of \d+", shown)
        terminal.forget()
        terminal.resize(8, 72)
        terminal.shows(r"\.\.\. \d+ more lines", "a page for the smaller window")
        terminal.forget()
        terminal.press(b"\x03")
        terminal.shows(r"\x1b\[\?1049l.*b02 +beacon", "the screen from before, with what was seen last")
        assert terminal.exit_code() == 130
