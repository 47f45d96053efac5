"""Debian's nats-server: whether it is there, a hub and the leaf nodes of sites, and uplinks between them."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Self

from tests.meshctl.monitor.prometheus_program import free_tcp_port
from tests.meshctl.sites.forwarder import CuttableUplink
from tests.waiting import until

NEEDS_NATS = "MESHCTL_TESTS_NEED_NATS"
PROGRAM = "nats-server"
WAIT_S = 60.0


def expects_nats() -> bool:
    """Whether its tests run: where it is installed, and where it must be."""
    return bool(os.environ.get(NEEDS_NATS)) or shutil.which(PROGRAM) is not None


class NatsServerProcess:
    """A server with JetStream on loopback; `more` is added to its configuration, `limits` to that of
    JetStream."""

    def __init__(
        self,
        directory: Path,
        name: str,
        domain: str,
        more: Mapping[str, object],
        limits: Mapping[str, object] = MappingProxyType({}),
    ) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.port = free_tcp_port()
        self.url = f"nats://127.0.0.1:{self.port}"
        self.store = directory / f"{name}-store"
        jetstream = {"store_dir": str(self.store), "domain": domain, **limits}
        config = {"listen": f"127.0.0.1:{self.port}", "server_name": name, "jetstream": jetstream, **more}
        self.config = directory / f"{name}.conf"
        # JSON is a configuration of nats-server
        self.config.write_text(json.dumps(config))
        self._log = directory / f"{name}.log"
        self.start()

    def start(self) -> None:
        with self._log.open("ab") as log:
            self.process = subprocess.Popen([PROGRAM, "-c", str(self.config)], stdout=log, stderr=log)
        until(lambda: "Server is ready" in self._log.read_text(), f"a server in {self._log}", wait_s=WAIT_S)

    def reload(self, config: str) -> None:
        """Let the running server read another configuration."""
        self.config.write_text(config)
        self.process.send_signal(signal.SIGHUP)

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()
        self._log.unlink(missing_ok=True)


class NatsSites:
    """A hub, and a leaf node of each site behind an uplink that can be cut."""

    def __init__(self, directory: Path, sites: Iterable[str], leaf_store_bytes: int | None = None) -> None:
        """`leaf_store_bytes` is how much of its disk a leaf node may use."""
        limits = {} if leaf_store_bytes is None else {"max_file_store": leaf_store_bytes}
        leaf_port = free_tcp_port()
        # the hub advertises its address to leaf nodes, which would pass by the uplink: one where nothing listens
        leafnodes = {"listen": f"127.0.0.1:{leaf_port}", "advertise": "127.0.0.1:1"}
        self.hub = NatsServerProcess(directory, "hub", "hub", {"leafnodes": leafnodes})
        self.uplinks: dict[str, CuttableUplink] = {}
        self.leaves: dict[str, NatsServerProcess] = {}
        for site in sites:
            uplink = self.uplinks[site] = CuttableUplink(leaf_port)
            remote = {"reconnect": 1, "remotes": [{"url": f"nats://127.0.0.1:{uplink.port}"}]}
            self.leaves[site] = NatsServerProcess(directory, f"leaf-{site}", site, {"leafnodes": remote}, limits)

    def close(self) -> None:
        for server in (*self.leaves.values(), self.hub):
            server.stop()
        for uplink in self.uplinks.values():
            uplink.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
