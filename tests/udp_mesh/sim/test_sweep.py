"""`udp-mesh sim sweep` as its users run it: settings that are checked, results that survive, a real Dask cluster."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

from meshlab.namespaces import die_with_parent
from tests.waiting import until
from udp_mesh.sim import main
from udp_mesh.sim.sweep import run_sweep

SCENARIO = """\
# a comment
seed: 3
duration_s: 4
robots:
  a: [0, 0]
  b: {path: [[0, 10, 0], [5, 20, 0]]}
air:
  range_m: 200
topics:
  estop: {priority: 0}
flows:
  - {topic: estop, sources: [a], destination: b, period_s: 1, size_bytes: 20, start_s: 1}
"""
ROOT = Path(__file__).parents[3]
INLINE = ["--executor", "tests.mesh_sweep.sample:InlineExecutor"]
COMMAND = [sys.executable, "-m", "udp_mesh.cli.main"]


@pytest.fixture
def scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.yaml"
    path.write_text(SCENARIO)
    return path


def test_settings_are_compared_and_a_second_run_computes_nothing(
    scenario: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(scenario), "--seeds", "3", "--set", "loss=0.5,0", "--json", *INLINE]
    assert run_sweep([*words, "--report", "mine.html", "--goal", "topics.estop.latency_p99_s<=0.5"]) == 0
    found = json.loads(capsys.readouterr().out)
    names = [figure["name"] for figure in found["figures"]]
    assert names[0] == "topics.estop.latency_p99_s<=0.5"
    assert "channel.airtime_share" in names
    assert [row["set"] for row in found["figures"][1]["settings"]] == [
        {"air.least_loss": "0"}, {"air.least_loss": "0.5"}
    ]  # fmt: skip
    assert found["runs"] == 6
    assert "</html>" in Path("mine.html").read_text()
    first = Path("mine-sweep.jsonl").read_bytes()
    assert run_sweep(words) == 0
    printed = capsys.readouterr()
    assert printed.err == "mine-sweep.jsonl: 6 of 6 cases have a result already\n"
    assert json.loads(printed.out)["figures"] == found["figures"][1:]
    assert Path("mine-sweep.jsonl").read_bytes() == first
    # more seeds later: the old results remain
    assert run_sweep([str(scenario), "--seeds", "4", "--set", "loss=0,0.5", *INLINE]) == 0
    capsys.readouterr()
    rows = [json.loads(line) for line in Path("mine-sweep.jsonl").read_text().splitlines()]
    assert [(row["set"]["air.least_loss"], row["seed"]) for row in rows] == [
        (loss, seed) for loss in ("0", "0.5") for seed in range(1, 5)
    ]
    assert run_sweep(["--show", "mine-sweep.jsonl", "--figure", "accepted"]) == 0
    assert "8 runs of scenario mine" in capsys.readouterr().out


def test_a_report_never_replaces_the_results_that_it_shows(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_sweep([str(scenario), "--seeds", "1", *INLINE]) == 0
    results = Path("mine-sweep.jsonl").read_bytes()
    words = ["--report", str(Path.cwd() / "mine-sweep.jsonl")]
    assert run_sweep([str(scenario), "--seeds", "1", *words, *INLINE]) == 2
    assert run_sweep(["--show", "mine-sweep.jsonl", *words]) == 2
    assert capsys.readouterr().err.count("expected another file than that of the results: give it another name") == 2
    assert Path("mine-sweep.jsonl").read_bytes() == results


def test_a_report_does_not_replace_the_scenario(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = scenario.read_bytes()
    assert run_sweep([str(scenario), "--seeds", "1", "--report", str(scenario), *INLINE]) == 2
    assert "expected another file than those of the scenario: give it another name" in capsys.readouterr().err
    assert scenario.read_bytes() == before


def test_one_seed_is_the_run_that_sim_makes(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_sweep([str(scenario), "--seeds", "7-7", *INLINE]) == 0
    assert main([str(scenario), "--seed", "7", "--json"]) == 0
    printed = capsys.readouterr().out
    summary = json.loads(printed[printed.index("\n{") :])
    figures = json.loads(Path("mine-sweep.jsonl").read_text())["figures"]
    assert figures["channel.transmissions"] == summary["channel"]["transmissions"]
    assert figures["topics.estop.latency_p99_s"] == summary["topics"]["estop"]["latency_p99_s"]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--set", "loss=0,2"], "udp-mesh: {file}:8: air.least_loss: expected a number of at most 1, found '2' "
         "(--set air.least_loss=2)"),
        (["--set", "air.least_los=0"], "(did you mean 'least_loss'?), found 'least_los' (--set air.least_los=0)"),
        (["--set", "topics.estopp.priority=1"], "udp-mesh: {file}:10: --set topics.estopp.priority=1: topics: expected "
         "one of estop (did you mean 'estop'?), found 'estopp'"),
        (["--set", "flows[1].period_s=2"], "expected flows[0] to flows[0], found 1"),
        (["--set", "flows[0].period_s=0"], "{file}:12: flows[0].period_s: expected a number of at least 0.001"),
        (["--set", "flows[0].spread=9"], "{file}:12: flows[0].spread: expected a number of at most 5, found '9'"),
        (["--set", "air.good_m=300"], "{file}:8: air: expected range_m of at least good_m, 300, found 200.0"),
        (["--seeds", "0"], "udp-mesh: --seeds: expected a number (1000) or a range (501-1000)"),
        (["--dask", "tcp://x:1", "--executor", "a:b"], "expected --dask or --executor, found both"),
        (["--report", "no/such/dir.html"], "udp-mesh: no/such/dir.html: No such file or directory"),
        (["--report", "./mine-sweep.jsonl"], "mine-sweep.jsonl: expected another file than that of the results"),
        (["--figure", "zzz", "--seeds", "1", *INLINE], "found 'zzz'; they have accepted, "),
        (["--figure", "accepte", "--seeds", "1", *INLINE], "found 'accepte'; did you mean 'accepted'?"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_reported_with_its_place(
    words: list[str], problem: str, scenario: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_sweep([str(scenario), *words]) == 2
    assert problem.format(file=scenario) in capsys.readouterr().err


def test_a_robot_without_the_engine_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith("mesh_sweep") or name == "udp_mesh.sim.sweep"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mesh_sweep", None)
    assert main(["sweep", "final-run"]) == 2
    assert "install meshctl-fleet" in capsys.readouterr().err


def test_results_of_another_scenario_are_refused(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_sweep([str(scenario), "--seeds", "1", *INLINE]) == 0
    before = Path("mine-sweep.jsonl").read_bytes()
    # a comment is no other scenario
    scenario.write_text(SCENARIO.replace("a comment", "another comment"))
    assert run_sweep([str(scenario), "--seeds", "1", *INLINE]) == 0
    scenario.write_text(SCENARIO.replace("range_m: 200", "range_m: 100"))
    capsys.readouterr()
    assert run_sweep([str(scenario), "--seeds", "1", *INLINE]) == 2
    assert "mine-sweep.jsonl:1: expected results of scenario mine (" in capsys.readouterr().err
    assert Path("mine-sweep.jsonl").read_bytes() == before


CASES = 8
SLOW = SCENARIO.replace("period_s: 1", "period_s: 0.005").replace("duration_s: 4", "duration_s: 5")
"""A quarter of a second for each case: enough to interrupt a sweep of them."""


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The results of the slow scenario from this process."""
    directory = tmp_path_factory.mktemp("one-process")
    (directory / "mine.yaml").write_text(SLOW)
    out = directory / "out.jsonl"
    assert run_sweep([str(directory / "mine.yaml"), "--seeds", str(CASES), "--out", str(out), *INLINE]) == 0
    return out.read_bytes()


@contextmanager
def started(*words: str) -> Iterator[subprocess.Popen[str]]:
    """A process of its own group, which ends with the block, and with the tests if those are killed."""
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True, env={**os.environ,
        "PYTHONPATH": str(ROOT)}, preexec_fn=die_with_parent,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def wait_for_lines(path: Path, count: int, process: subprocess.Popen[str]) -> None:
    def are_there() -> bool:
        if path.exists() and path.read_bytes().count(b"\n") >= count:
            return True
        assert process.poll() is None, process.stdout.read() if process.stdout else ""
        return False

    until(are_there, f"{count} lines of {path.name}", wait_s=120)


def test_an_interrupted_sweep_continues_with_the_same_bytes(scenario: Path, one_process: bytes) -> None:
    scenario.write_text(SLOW)
    words = [str(scenario), "--seeds", str(CASES)]
    out = Path("mine-sweep.jsonl")
    with started(*COMMAND, "sim", "sweep", *words, "--jobs", "2") as process:
        wait_for_lines(out, 1, process)
        # as Ctrl-C in a terminal: every process of the group gets it
        os.killpg(process.pid, signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "cases are in mine-sweep.jsonl; run the same command to continue" in output
    assert "Traceback" not in output
    have = out.read_bytes()
    assert 1 <= have.count(b"\n") < CASES
    # a power cut in the middle of a line
    out.write_bytes(have + have[: have.index(b"\n") // 2])
    with started(*COMMAND, "sim", "sweep", *words, "--jobs", "2") as process:
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "cut off an incomplete last line" in output
    assert f"{have.count(bytes([10]))} of {CASES} cases have a result already" in output
    assert out.read_bytes() == one_process


@contextmanager
def dask_scheduler(address_file: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A Dask scheduler on loopback, with its address, which is also in the file."""
    with started(
        sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
        "--no-dashboard", "--scheduler-file", str(address_file),
    ) as scheduler:  # fmt: skip

        def is_up() -> bool:
            assert scheduler.poll() is None
            return address_file.exists() and address_file.read_text().endswith("}")

        until(is_up, "the Dask scheduler", wait_s=120)
        yield scheduler, json.loads(address_file.read_text())["address"]


def test_a_dask_cluster_that_loses_a_worker_gives_the_same_bytes(
    scenario: Path, tmp_path: Path, one_process: bytes
) -> None:
    """Scheduler and two workers as processes on loopback; one worker is killed in the middle."""
    scenario.write_text(SLOW)
    words = [str(scenario), "--seeds", str(CASES)]
    out, address_file = tmp_path / "dask.jsonl", tmp_path / "scheduler.json"
    with ExitStack() as stack:
        _, address = stack.enter_context(dask_scheduler(address_file))
        first, _ = (
            stack.enter_context(
                started(sys.executable, "-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1",
                        "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path))
            )
            for _ in range(2)
        )  # fmt: skip
        cluster = ["--dask", str(address_file)]
        sweep = stack.enter_context(started(*COMMAND, "sim", "sweep", *words, *cluster, "--out", str(out)))
        wait_for_lines(out, 2, sweep)
        first.kill()
        output, _ = sweep.communicate(timeout=200)
        assert sweep.returncode == 0, output
    assert out.read_bytes() == one_process


def test_a_dask_scheduler_that_is_killed_ends_the_sweep_with_one_line(scenario: Path, tmp_path: Path) -> None:
    with dask_scheduler(tmp_path / "scheduler.json") as (scheduler, address):
        words = [*COMMAND, "sim", "sweep", str(scenario), "--seeds", "2", "--dask", address]
        with started(*words) as sweep:
            assert sweep.stdout is not None
            assert sweep.stdout.readline() == f"{address} has no workers: waiting for one\n"
            scheduler.kill()
            output, _ = sweep.communicate(timeout=120)
    assert sweep.returncode == 2
    (line,) = output.splitlines()
    assert line.endswith("the results so far are kept, and the same command continues")
