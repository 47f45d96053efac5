"""Two sites of virtual nodes with permanent workers, reached over NATS alone through uplinks that a test can cut."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from meshctl.sites.runs import SiteDirectory
from tests.meshctl.device.servers import public
from tests.meshctl.sites.nats_servers import NatsSites
from tests.meshctl.sites.rig import INVENTORY, NORTH, SECRETS, SOUTH, FleetRig

_SITES = "sites:\n"
_DEFAULTS = "defaults:"


class NatsRig(FleetRig):
    """Use it in a `with` block: the nodes are bootstrapped and accept the workers, which run."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.servers = NatsSites(directory / "nats", SECRETS)
        self.uplinks = self.servers.uplinks
        self._gateway_environment = {
            **self.environment,
            "XDG_STATE_HOME": str(directory / "gateway"),
            "HOME": str(directory / "gateway"),
        }
        self._workers: dict[str, subprocess.Popen[bytes]] = {}

    def directory_of(self, site: str) -> SiteDirectory:
        return SiteDirectory.of(f"mines/{site}", self._gateway_environment)

    def site_directory(self, site: str) -> Path:
        return self.directory_of(site).root

    def _set_up(self) -> None:
        operator = public(self.key).read_text().strip()
        secrets = self.directory / "secrets.yaml"
        secrets.write_text(json.dumps(SECRETS))
        secrets.chmod(0o600)
        ports = dict.fromkeys(SECRETS, 22)
        text = INVENTORY.format(key=operator, private=self.key, secrets=secrets, **ports)
        head, _, rest = text.partition(_SITES)
        _, _, tail = rest.partition(_DEFAULTS)
        lines = [f"nats: {{url: {self.servers.hub.url}}}", "sites:"]
        for site in SECRETS:
            key = self.directory_of(site).install([operator])
            ssh = f'ssh: {{key_files: ["{self.key}"]}}'
            lines.append(f"  {site}: {{nats: {{}}, {ssh}, worker_key: {key}}}")
        self.start_lab(head + "\n".join(lines) + f"\n{_DEFAULTS}{tail}")
        self.run("bootstrap", *NORTH, *SOUTH, "--yes", "--json", expected=0)
        self.run("lab", "unplug", expected=0)
        for site in SECRETS:
            self.start_worker(site)

    def start_worker(self, site: str) -> None:
        command = [sys.executable, "-m", "meshctl", "worker", f"mines/{site}", "--nats", self.servers.leaves[site].url]
        with (self.directory / f"worker-{site}.log").open("ab") as log:
            self._workers[site] = subprocess.Popen(
                command, env=self._gateway_environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip

    def stop_worker(self, site: str) -> None:
        """Kill it, as a gateway that is updated does: its runs go on."""
        worker = self._workers.pop(site)
        worker.kill()
        worker.wait()

    def log_of(self, site: str) -> str:
        return (self.directory / f"worker-{site}.log").read_text()

    def close(self) -> None:
        for site in tuple(self._workers):
            self.stop_worker(site)
        super().close()
        self.servers.close()


def kill_group(process: subprocess.Popen[bytes]) -> None:
    os.killpg(process.pid, 9)
    process.wait()
