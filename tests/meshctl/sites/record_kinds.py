"""`python -m tests.meshctl.sites.record_kinds`: record virtual nodes of several kinds for `recorded_site`.

Models, releases and states: each node is planned and changed once by meshctl's own `plan` and `apply`, and what they
print of it becomes `recordings/KIND.json`.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from tests.meshctl.device.servers import public
from tests.meshctl.sites.recorded_site import MESH, NODE, RECORDINGS
from tests.meshctl.sites.rig import FleetRig

MODELS = {
    "compex-2410": ("compex,wpj344-16m", "24.10", "platform/ahb/18100000.wmac"),
    "rocket-2305": ("ubnt,rocket-m", "23.05", "pci0000:00/0000:00:00.0"),
    "mikrotik-2512": ("mikrotik,routerboard-912uag-2hpnd", "25.12", "platform/ahb/18100000.wmac"),
    "light-2203": ("compex,wpj531-16m", "22.03", "platform/ahb/18100000.wmac"),
}
# kind -> the fault of a node like the first model
FAULTS = {
    "foreign-change": "foreign-delta",
    "wrong-board": "wrong-board",
    "full-flash": "full-flash",
    "power-cut": "power-cut@reload_config",
}
UP_TO_DATE = "up-to-date"


def inventory(key: str) -> str:
    hardware = "".join(
        f"  {name}: {{board: '{board}', profile: {board.replace(',', '_')}, target: ath79/generic, "
        f'release: "{release}", lan_ports: [eth0], confirm_window_s: 60, radios: {{radio0: '
        f"{{path: '{path}', band: 2g, rated_power_dbm: 30, max_drive_dbm: 27}}}}}}\n"
        for name, (board, release, path) in MODELS.items()
    )
    first, *others = MODELS
    nodes = f"  recorded-base: {{role: base, hardware: {first}}}\n  recorded-{first}: {{hardware: {first}}}\n"
    nodes += "".join(f"  recorded-{name}: {{hardware: {name}}}\n" for name in others)
    nodes += "".join(f"  recorded-{name}: {{hardware: {first}}}\n" for name in FAULTS)
    nodes += f"  recorded-{UP_TO_DATE}: {{hardware: {first}, radios: {{radio0: {{tx_power_dbm: 20}}}}}}\n"
    return f"""\
meshctl: 1
fleet: mines
country: US
operators: {{ssh_keys: ["{key}"]}}
hardware:
{hardware}meshes:
  kinds: {{ssid: kinds, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/24}}
defaults: {{state: deployed, radios: {{radio0: {{mesh: kinds}}}}, address: {{from: 10.42.0.1}}}}
nodes:
{nodes}"""


class KindsRig(FleetRig):
    def _set_up(self) -> None:
        self.start_lab(inventory(public(self.key).read_text().strip()))
        self.run("bootstrap", "recorded-*", "--yes", "--json", expected=0)
        self.run("lab", "unplug", expected=0)


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="kinds-") as scratch, KindsRig(Path(scratch)) as rig:
        text = rig.inventory.read_text()
        rig.inventory.write_text(text.replace("max_drive_dbm: 27", "max_drive_dbm: 26"))
        record(rig, ("base", *MODELS, UP_TO_DATE))
        for kind, fault in FAULTS.items():
            rig.run("lab", "break", f"recorded-{kind}", fault, expected=0)
            # in a run of its own: a failure stops a run
            record(rig, (kind,))


def record(rig: KindsRig, kinds: tuple[str, ...]) -> None:
    """Plan and change the nodes of these kinds, and write down what was printed."""
    file = rig.directory / "plan.json"
    rig.run("plan", *(f"recorded-{kind}" for kind in kinds), "--out", str(file), "--brief")
    applied = rig.run("apply", str(file), "--json")
    document = json.loads(file.read_text())
    for kind in kinds:
        write_recording(kind, document, applied.events)


def write_recording(kind: str, document: dict[str, object], events: list[dict[str, object]]) -> None:
    node = f"recorded-{kind}"
    planned = document["nodes"]
    assert isinstance(planned, list)
    found = {
        "plan": next(each for each in planned if each["node"] == node),
        "events": [event for event in events if event.get("node") == node],
    }
    text = json.dumps(found, indent=1).replace(node, NODE).replace('"kinds"', f'"{MESH}"')
    (RECORDINGS / f"{kind}.json").write_text(text + "\n")
    sys.stderr.write(f"{kind}: {found['plan']['verdict']}, {found['events'][-1]['outcome']['result']}\n")


if __name__ == "__main__":
    main()
