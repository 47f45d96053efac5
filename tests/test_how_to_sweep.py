"""The guide on sweeps runs: every command of its `sh` blocks, in order, in one directory."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from meshlab.namespaces import die_with_parent

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "docs" / "how-to" / "sweep-missions.md"


SRUN = """\
#!/bin/sh
# as `srun` in a job of two tasks
"$@" & "$@" & wait
"""
# a worker that starts slowly must not find the sweep done, and the scheduler gone
BOTH_JOINED = "from distributed import Client; Client(scheduler_file='sweep.json').wait_for_workers(2, timeout=200)"


def test_the_job_script_of_the_guide_runs_with_two_workers(tmp_path: Path) -> None:
    (script,) = re.findall(r"^```bash\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    text, count = re.subn(r"final-run .* --dask", "partition-soak --seeds 2 --set duration_s=5 --dask", script)
    assert count == 1
    text = re.sub(r"dask (scheduler|worker)", r"dask \1 --host 127.0.0.1", text.rstrip())
    text += f' && python -c "{BOTH_JOINED}"'
    (tmp_path / "venv").symlink_to(Path(sys.executable).parents[1])
    (tmp_path / "bin").mkdir()
    srun = tmp_path / "bin/srun"
    srun.write_text(SRUN)
    srun.chmod(0o755)
    # of an earlier job
    (tmp_path / "sweep.json").write_text('{"address": "tcp://127.0.0.1:1"}')
    path = f"{srun.parent}:{os.environ['PATH']}"
    job = subprocess.Popen(
        ["sh", "-c", text], cwd=tmp_path, env={**os.environ, "PATH": path}, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, start_new_session=True, preexec_fn=die_with_parent,
    )  # fmt: skip
    try:
        output, _ = job.communicate(timeout=300)
    finally:
        # as Slurm ends what a job leaves
        with suppress(ProcessLookupError):
            os.killpg(job.pid, signal.SIGKILL)
    assert job.returncode == 0, output
    assert "2 runs of scenario partition-soak" in output
    assert (tmp_path / "workers.log").read_text().count("Start worker at") == 2
    assert (tmp_path / "partition-soak-sweep.jsonl").read_bytes().count(b"\n") == 2


def test_the_commands_of_the_guide_run(tmp_path: Path) -> None:
    blocks = re.findall(r"^```sh\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    (tmp_path / "inventory").symlink_to(ROOT / "inventory")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", "-eu"],
        input="".join(blocks),
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("10 of 12 cases have a result already") == 1
    assert "12 runs of scenario partition-soak" in done.stdout
    assert "runs with topics.estop.latency_p99_s<=0.1" in done.stdout
    assert "beacons.b02.drop_s=99 trial.route_s=10" in done.stdout
    assert "</html>" in (tmp_path / "soak.html").read_text(encoding="utf-8")
