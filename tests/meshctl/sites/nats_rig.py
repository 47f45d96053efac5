"""Two sites of virtual nodes with permanent workers, reached over NATS alone through uplinks that a test can cut."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from meshctl.sites.runs import SiteDirectory
from tests.meshctl.device.servers import public
from tests.meshctl.sites.nats_servers import NatsSites
from tests.meshctl.sites.recorded_site import MODULE as RECORDED
from tests.meshctl.sites.recorded_site import VIRTUAL_VARIABLE
from tests.meshctl.sites.rig import INVENTORY, NORTH, SECRETS, SOUTH, FleetRig

# Virtual nodes that are set up at the same time.
_AT_ONCE = 8
_SHARED_WINDOW_S = 600


class NatsRig(FleetRig):
    """Use it in a `with` block: the nodes are bootstrapped and accept the workers, which run. `recorded` are further
    sites, with so many nodes each that are recordings, except the bases of the first `virtual_bases` of them;
    `with_lab` False: only those."""

    def __init__(
        self,
        directory: Path,
        recorded: Mapping[str, int] | None = None,
        *,
        with_lab: bool = True,
        virtual_bases: int = 0,
    ) -> None:
        super().__init__(directory)
        self.recorded = {site: _names(site, count) for site, count in (recorded or {}).items()}
        self.virtual_bases = {site: names[:1] for site, names in list(self.recorded.items())[:virtual_bases]}
        self.real: dict[str, tuple[str, ...]] = {"north": NORTH, "south": SOUTH} if with_lab else {}
        if not with_lab:
            self.environment.pop("MESHCTL_LAB")
        self.servers = NatsSites(directory / "nats", self.nodes)
        self.uplinks = self.servers.uplinks
        self._gateway_environment = {
            **self.environment,
            "XDG_STATE_HOME": str(directory / "gateway"),
            "HOME": str(directory / "gateway"),
        }
        self._workers: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def nodes(self) -> dict[str, tuple[str, ...]]:
        """Site -> its nodes."""
        return {**self.real, **self.recorded}

    @property
    def virtual(self) -> tuple[str, ...]:
        """The nodes that are virtual."""
        return tuple(name for names in (*self.real.values(), *self.virtual_bases.values()) for name in names)

    def directory_of(self, site: str) -> SiteDirectory:
        return SiteDirectory.of(f"mines/{site}", self._gateway_environment)

    def site_directory(self, site: str) -> Path:
        return self.directory_of(site).root

    def _set_up(self) -> None:
        if self.real:
            self.start_lab(self._text({**self.real, **self.virtual_bases}))
            for first in range(0, len(self.virtual), _AT_ONCE):
                nodes = self.virtual[first : first + _AT_ONCE]
                self.run("bootstrap", *nodes, "--yes", "--json", expected=0)
            self.run("lab", "unplug", expected=0)
        self.inventory.parent.mkdir(parents=True, exist_ok=True)
        if self.recorded:
            written = self.inventory.read_text() if self.real else ""
            self.inventory.write_text(_with_lab_keys(self._text(self.nodes), written))
        for site in self.nodes:
            self.start_worker(site)

    def _text(self, sites: Mapping[str, tuple[str, ...]]) -> str:
        """The inventory with these sites."""
        operator = public(self.key).read_text().strip()
        secrets = self.directory / "secrets.yaml"
        secrets.write_text(json.dumps(SECRETS | {site: f"a-secret-of-{site}" for site in self.recorded}))
        secrets.chmod(0o600)
        text = INVENTORY.format(key=operator, private=self.key, secrets=secrets, **dict.fromkeys(SECRETS, 22))
        head, _, rest = text.partition("sites:\n")
        groups, _, nodes = rest.partition("defaults:")[2].partition("nodes:\n")
        meshes = lines = ""
        if not self.real:
            nodes = ""
            lines = "".join(f"  {site}: {{}}\n" for site in SECRETS)
        for number, (site, names) in enumerate(sites.items(), 1):
            key = self.directory_of(site).install([operator])
            lines += f'  {site}: {{nats: {{}}, ssh: {{key_files: ["{self.key}"]}}, worker_key: {key}}}\n'
            if site in self.recorded:
                meshes += (
                    f"  {site}: {{ssid: {site}, band: 2g, channel: 1, network: 10.{100 + number}.0.0/24, "
                    f'bssid: "02:ca:fe:01:00:{number:02x}", encryption: psk2+ccmp, '
                    f"key: {{file: {secrets}, key: {site}}}}}\n"
                )
                address = f"address: {{from: 10.{100 + number}.0.1}}"
                groups += f"  {site}: {{site: {site}, radios: {{radio0: {{mesh: {site}}}}}, {address}}}\n"
                nodes += f"  {names[0]}: {{role: base, groups: [{site}]}}\n"
                if len(names) > 1:
                    nodes += f"  {site}-n[01-{len(names) - 1:02}]: {{groups: [{site}]}}\n"
        if self.virtual_bases:
            # all sites share this machine's processors, and none has them at the pace of its own gateway
            head = head.replace("confirm_window_s: 60", f"confirm_window_s: {_SHARED_WINDOW_S}")
        return f"{head}{meshes}nats: {{url: {self.servers.hub.url}}}\nsites:\n{lines}defaults:{groups}nodes:\n{nodes}"

    def start_worker(self, site: str) -> None:
        program = RECORDED if site in self.recorded else "meshctl"
        command = [sys.executable, "-m", program, "worker", f"mines/{site}", "--nats", self.servers.leaves[site].url]
        environment = self._gateway_environment | ({VIRTUAL_VARIABLE: "1"} if site in self.virtual_bases else {})
        with (self.directory / f"worker-{site}.log").open("ab") as log:
            self._workers[site] = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
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


def _with_lab_keys(text: str, written: str) -> str:
    """The inventory with the lines in which the lab has written its keys."""
    kept = {
        line.partition(":")[0]: line for line in written.splitlines() if line.startswith(("operators:", "defaults:"))
    }
    return "".join(f"{kept.get(line.partition(':')[0], line)}\n" for line in text.splitlines())


def _names(site: str, count: int) -> tuple[str, ...]:
    return (f"{site}-base", *(f"{site}-n{number:02}" for number in range(1, count)))
