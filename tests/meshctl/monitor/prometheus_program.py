"""Debian's prometheus and promtool: whether they are there, and one running for a test."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.waiting import until

NEEDS_PROMETHEUS = "MESHCTL_TESTS_NEED_PROMETHEUS"
WAIT_S = 60.0


def expects_prometheus() -> bool:
    """Whether its tests are collected: where it is installed, and where it must be."""
    return bool(os.environ.get(NEEDS_PROMETHEUS)) or all(shutil.which(name) for name in ("prometheus", "promtool"))


def promtool(*arguments: str) -> str:
    """Its output; fails with that if its exit status is not 0."""
    done = subprocess.run(["promtool", *arguments], capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def free_tcp_port() -> int:
    """A port on loopback that is free at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Prometheus:
    """A running server."""

    def __init__(self, port: int) -> None:
        self._url = f"http://127.0.0.1:{port}/api/v1"

    def get(self, path: str, **parameters: str) -> Any:
        """The `data` of an answer of the HTTP API; fails with its error."""
        url = f"{self._url}/{path}?{urllib.parse.urlencode(parameters)}"
        try:
            with urllib.request.urlopen(url, timeout=WAIT_S) as answer:
                document = json.load(answer)
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{path} {parameters}: {error.read().decode()}") from error
        assert document["status"] == "success", document
        return document["data"]

    def query(self, expression: str) -> dict[str, float]:
        """The values of an instant query by their labels, as JSON without the name."""
        found = {}
        for one in self.get("query", query=expression)["result"]:
            labels = {name: value for name, value in one["metric"].items() if name not in ("__name__", "job")}
            found[json.dumps(labels, sort_keys=True)] = float(one["value"][1])
        return found


@contextmanager
def running(folder: Path, targets: dict[str, str], *, rules: str = "", file_sd: str = "") -> Iterator[Prometheus]:
    """A server that scrapes `targets` (job -> host:port) every second."""
    port = free_tcp_port()
    (folder / "rules.yml").write_text(rules or "groups: []\n")
    (folder / "targets.json").write_text(file_sd or "[]")
    jobs = [{"job_name": job, "static_configs": [{"targets": [target]}]} for job, target in targets.items()]
    jobs.append({"job_name": "radios", "file_sd_configs": [{"files": [str(folder / "targets.json")]}]})
    config = {
        "global": {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"},
        "rule_files": [str(folder / "rules.yml")],
        "scrape_configs": jobs,
    }
    # JSON is YAML
    (folder / "prometheus.yml").write_text(json.dumps(config))
    command = ["prometheus", f"--config.file={folder / 'prometheus.yml'}", f"--storage.tsdb.path={folder / 'data'}"]
    log = folder / "prometheus.log"
    with log.open("wb") as out:
        process = subprocess.Popen(
            [*command, f"--web.listen-address=127.0.0.1:{port}", "--log.level=warn"], stdout=out, stderr=out
        )
    try:
        server = Prometheus(port)

        def is_ready() -> bool:
            assert process.poll() is None, log.read_text()
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/-/ready", timeout=5):
                    return True
            except OSError:
                return False

        until(is_ready, "prometheus to be ready", wait_s=WAIT_S)
        yield server
    finally:
        process.terminate()
        process.wait(WAIT_S)
