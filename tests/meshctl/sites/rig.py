"""Two sites of virtual nodes, a gateway with a real OpenSSH server, and uplinks that a test can cut.

Both sites are served by workers on one gateway, each through an uplink of its own. The workers are those that `meshctl
sites install` put there.
"""

from __future__ import annotations

import json
import os
import re
import signal
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests.meshctl import forked_commands
from tests.meshctl.device.servers import keypair, openssh, public
from tests.meshctl.inventories import compex_hardware
from tests.meshctl.sites.forwarder import CuttableUplink
from tests.meshctl.sites.wheels import required_wheels
from tests.waiting import until

# Far above what any command needs on a busy machine; a hang ends here.
LIMIT_S = 300.0
NORTH, SOUTH = ("n-base", "n1", "n2"), ("s-base",)
# it is set up on the bench of its site's gateway
AT_SITE = "n2"
SECRETS = {"north": "a-secret-of-the-north", "south": "a-secret-of-the-south"}
INVENTORY = (
    """\
meshctl: 1
fleet: mines
country: US
operators: {{ssh_keys: ["{key}"]}}
apply: {{canary: true}}
hardware:
"""
    + compex_hardware("24.10", confirm_window_s=60)
    + """\
meshes:
  north:
    ssid: north
    bssid: "02:ca:fe:00:00:01"
    band: 2g
    channel: 6
    network: 10.42.0.0/24
    encryption: psk2+ccmp
    key: {{file: {secrets}, key: north}}
  south:
    ssid: south
    bssid: "02:ca:fe:00:00:02"
    band: 2g
    channel: 11
    network: 10.43.0.0/24
    encryption: psk2+ccmp
    key: {{file: {secrets}, key: south}}
sites:
  north:
    ssh: {{host: 127.0.0.1, port: {north}, user: root, key_files: ["{private}"]}}
  south:
    ssh: {{host: 127.0.0.1, port: {south}, user: root, key_files: ["{private}"]}}
defaults: {{hardware: box, state: deployed}}
groups:
  north: {{site: north, radios: {{radio0: {{mesh: north}}}}, address: {{from: 10.42.0.1}}}}
  south: {{site: south, radios: {{radio0: {{mesh: south}}}}, address: {{from: 10.43.0.1}}}}
nodes:
  n-base: {{role: base, groups: [north]}}
  n[1-2]: {{groups: [north]}}
  s-base: {{role: base, groups: [south]}}
"""
)


@dataclass(frozen=True, slots=True)
class Ended:
    code: int
    out: str
    err: str

    @property
    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.out.splitlines() if line.startswith("{")]

    @property
    def results(self) -> dict[str, str]:
        """Node -> the result of its last outcome."""
        ended = next(event for event in reversed(self.events) if event["event"] == "ended")
        return {outcome["node"]: outcome["result"] for outcome in ended["outcomes"]}


class Started:
    """A meshctl process that is still running; its output goes to a file, which can be read meanwhile."""

    def __init__(self, rig: FleetRig, words: tuple[str, ...], number: int) -> None:
        self.out = rig.directory / f"command-{number}.out"
        self._err = rig.directory / f"command-{number}.err"
        with self.out.open("wb") as out, self._err.open("wb") as err:
            self.process = forked_commands.start(words, rig.environment, out, err)

    def wait_for(self, pattern: str) -> None:
        """Wait until its output has this."""

        def has_it() -> bool:
            text = self.out.read_text() + self._err.read_text()
            assert self.process.poll() is None or re.search(pattern, text), f"it ended: {text}"
            return re.search(pattern, text) is not None

        until(has_it, f"{pattern} in the output", wait_s=LIMIT_S)

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self) -> Ended:
        code = self.process.wait(LIMIT_S)
        return Ended(code, self.out.read_text(), self._err.read_text())


class FleetRig:
    """A virtual fleet, its inventory, and an operator with a home of their own. Use it in a `with` block."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.key = keypair(directory / "operator")
        self.lab = directory / "lab"
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("MESHCTL_")},
            "MESHCTL_LAB": str(self.lab),
            "MESHCTL_INVENTORY": str(self.lab / "inventory"),
            "XDG_STATE_HOME": str(directory / "state"),
            "XDG_CACHE_HOME": str(directory / "cache"),
            "XDG_CONFIG_HOME": str(directory / "config"),
            "HOME": str(directory),
        }
        self.environment.pop("SSH_AUTH_SOCK", None)
        self._count = 0

    @property
    def inventory(self) -> Path:
        return self.lab / "inventory" / "fleet.yaml"

    def site_directory(self, site: str) -> Path:
        raise NotImplementedError

    def __enter__(self) -> Self:
        try:
            self._set_up()
        except BaseException:
            self.close()
            raise
        return self

    def _set_up(self) -> None:
        raise NotImplementedError

    def start_lab(self, inventory: str) -> None:
        written = self.directory / "inventory"
        written.mkdir()
        (written / "fleet.yaml").write_text(inventory)
        self.run("lab", "up", str(written), "--dir", str(self.lab), expected=0)

    def run(self, *words: str, expected: int | None = None) -> Ended:
        ended = self.start(*words).end()
        assert expected is None or ended.code == expected, f"{words}: {ended}"
        return ended

    def start(self, *words: str) -> Started:
        self._count += 1
        return Started(self, words, self._count)

    @contextmanager
    def monitoring(self) -> Iterator[Callable[[str], Any]]:
        """`meshctl monitor` runs and has a frame; what its page reads at a place below `/api/`."""
        started = self.start("monitor", "--port", "0", "--interval", "1", "--json")
        try:
            started.wait_for('"event": "verdict"')
            url = json.loads(started.out.read_text().splitlines()[0])["url"]
            yield lambda place: _get(f"{url}api/{place}")
        finally:
            started.signal(signal.SIGTERM)
            started.end()

    def change_power(self) -> int:
        """Let the next provision change every node; returns the new drive level."""
        text = self.inventory.read_text()
        found = re.search(r"max_drive_dbm: (\d+)", text)
        assert found is not None
        power_dbm = 27 if found[1] != "27" else 26
        self.inventory.write_text(text.replace(found[0], f"max_drive_dbm: {power_dbm}"))
        return power_dbm

    def powers(self, nodes: Iterable[str] = (*NORTH, *SOUTH)) -> Mapping[str, str]:
        """The drive level that each node has, as read from it."""
        said = self.run("run", *nodes, "--json", "--", "uci get wireless.radio0.txpower", expected=0)
        return {item["node"]: item["stdout"].strip() for item in said.events}

    def started_run(self, site: str) -> Path:
        """The directory of the run that is in progress at a site."""
        runs = self.site_directory(site).glob("runs/*/order.json")
        return next(path.parent for path in runs if not (path.parent / "over.json").exists())

    def runs_at(self, site: str) -> dict[str, str]:
        """Run -> state, as the worker tells."""
        said = json.loads(self.run("sites", "status", site, "--json", expected=0).out)
        return {run["run"]: run["state"] for run in said[0]["runs"]}

    def close(self) -> None:
        if (self.lab / "inventory").exists():
            self.run("lab", "down")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SitesRig(FleetRig):
    """The nodes are bootstrapped, one of them on the gateway's bench; the workers are installed over SSH, and the nodes
    accept them."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.gateway = directory / "gateway"
        self.sshd = openssh(self.gateway, public(self.key), f"SetEnv MESHCTL_LAB={self.lab}", host_key_type="ed25519")
        self.uplinks = {site: CuttableUplink(self.sshd.port) for site in SECRETS}

    def site_directory(self, site: str) -> Path:
        return self.gateway / "root/.local/state/meshctl/sites/mines" / site

    def _set_up(self) -> None:
        secrets = self.directory / "secrets.yaml"
        secrets.write_text(json.dumps(SECRETS))
        secrets.chmod(0o600)
        ports = {site: uplink.port for site, uplink in self.uplinks.items()}
        key = public(self.key).read_text().strip()
        self.start_lab(INVENTORY.format(key=key, private=self.key, secrets=secrets, **ports))
        here = [node for node in (*NORTH, *SOUTH) if node != AT_SITE]
        self.run("bootstrap", *here, "--yes", "--json", expected=0)
        self.run("lab", "unplug", "n1", expected=0)
        self.run("sites", "trust", "--yes", expected=0)
        self.uplinks["north"].cut()
        lost = self.run("bootstrap", AT_SITE, "--at-site", "north", "--yes")
        assert (lost.code, "hint: check the uplink of north" in lost.err) == (3, True), lost
        self.uplinks["north"].mend()
        done = self.run("bootstrap", AT_SITE, "--at-site", "north", "--yes", expected=0)
        assert re.search(f"{AT_SITE}: found at .* at site north", done.out)
        self.run("lab", "unplug", expected=0)
        self.run("sites", "install", "--wheels", str(required_wheels(self.directory / "wheels")), expected=0)
        self.run("provision", "--direct", "--yes", "--json", expected=0)

    def kill(self, pid_there: int) -> None:
        """Kill a process of a run by its number in the gateway's own process namespace."""
        inside = (path for path in Path("/proc").glob("[0-9]*/status") if _is_worker(path))
        for path in inside:
            numbers = next((line.split()[1:] for line in path.read_text().splitlines() if line.startswith("NSpid")), [])
            if len(numbers) == 2 and int(numbers[1]) == pid_there:
                os.kill(int(numbers[0]), signal.SIGKILL)

    def close(self) -> None:
        super().close()
        for uplink in self.uplinks.values():
            uplink.close()
        self.sshd.stop()


def _get(url: str) -> Any:
    with urllib.request.urlopen(url, timeout=LIMIT_S) as answer:
        return json.load(answer)


def _is_worker(status: Path) -> bool:
    """Whether a process is meshctl's, on a gateway."""
    try:
        return b"meshctl" in (status.parent / "cmdline").read_bytes()
    except OSError:
        return False
