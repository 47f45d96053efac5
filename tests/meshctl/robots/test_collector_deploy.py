"""A collector deployed to a real Debian: a key of its own, a service beside the daemon, a radio it asks over SSH."""

from __future__ import annotations

import json
from typing import Any

from meshctl.device.trust import TrustStore
from meshctl.render.rendered import LINKS_PATH
from meshctl.resources import device_script
from tests.meshctl.device.servers import eventually
from tests.meshctl.robots.fleets import RobotFleet
from tests.meshctl.robots.test_systemd import MAX_EXPOSURE

# what a radio would print; the machine behind it is a Debian with OpenSSH
IW = """\
#!/bin/sh
case "$*" in
dev) printf 'phy#0\\n\\tInterface mesh0\\n\\t\\ttype mesh point\\n' ;;
*station*) printf 'Station 02:00:00:00:00:02 (on mesh0)\\n\\tinactive time:\\t40 ms\\n\\tsignal:  \\t-63 dBm\\n' ;;
*survey*) printf 'Survey data from mesh0\\n\\tfrequency:\\t\\t\\t2437 MHz [in use]\\n\\tnoise:\\t\\t\\t\\t-95 dBm\\n' ;;
esac
"""


def _conditions(fleet: RobotFleet) -> dict[str, Any]:
    text = fleet.shell("husky1", "/opt/udp-mesh/current/bin/udp-mesh status --json")
    found: dict[str, Any] = json.loads(text)["conditions"]
    return found


def _radio(fleet: RobotFleet) -> dict[str, Any]:
    radio: dict[str, Any] | None = _conditions(fleet)["radio"]
    return radio or {}


def test_a_collector_gets_a_key_that_its_radio_accepts_for_links_alone(fleet: RobotFleet) -> None:
    for name in ("husky1", "husky2", "radio"):
        fleet.add(name)
    fleet.write()
    text = fleet.file.read_text()
    radio = fleet.machines["radio"]
    # it is no robot, but the radio of husky1; that of husky2 does not exist
    text = text[: text.index("  radio:\n")] + text[text.index("udp_mesh:\n") :]
    text = text.replace("address: 10.42.0.1}", f"address: {radio.address}}}\n  rear: {{address: 10.42.0.9}}")
    text = text.replace("nodes: []", "nodes: [rear]")
    fleet.file.write_text(text.replace("    computer:\n", "    computer:\n      collector: true\n", 1))
    refused = fleet.deploy("husky1", exit_code=1)
    assert "no host key is pinned of its radios base" in refused
    assert "run `meshctl trust base`" in refused
    TrustStore(fleet.directory / "known_hosts").replace("base", radio.host_key)

    output = fleet.deploy()
    assert "let their radios accept it: meshctl provision base" in output
    key = fleet.shell("husky1", "cat /var/lib/udp-mesh/collector/id_ed25519.pub").strip()
    (written,) = (one for one in fleet.file.read_text().splitlines() if "collector_key: " in one)
    assert key in written
    assert fleet.shell("husky1", "stat -c '%U %a' /var/lib/udp-mesh/collector/id_ed25519").strip() == "udp-mesh 600"
    eventually(lambda: "base does not answer: " in str(_radio(fleet).get("problem")))
    assert "Permission denied" in _radio(fleet)["problem"]
    # a radio that does not answer yet is no reason to roll back
    assert fleet.status()["husky1"]["collector"]["active"] == "active"
    exposure = f"systemd-analyze security --no-pager --threshold={MAX_EXPOSURE} udp-mesh-collector.service"
    fleet.shell("husky1", exposure)
    assert fleet.shell("husky2", "ls /etc/systemd/system").count("udp-mesh-collector") == 0

    # the radio as the inventory now renders it
    fleet.root_command("render", "base", "--out", str(fleet.directory / "build"))
    built = fleet.directory / "build/base"
    assert (built / LINKS_PATH).read_text() == device_script("links.sh")
    (line,) = (one for one in (built / "etc/dropbear/authorized_keys").read_text().splitlines() if key in one)
    fleet.tool("radio", "iw", IW)
    fleet.shell("radio", f"mkdir -p /etc/meshctl && cat >/{LINKS_PATH} <<'END'\n{device_script('links.sh')}END")
    fleet.shell("radio", f"cat >>/root/.ssh/authorized_keys <<'END'\n{line}\nEND")
    eventually(lambda: bool(_radio(fleet).get("neighbors")))
    (neighbor,) = _radio(fleet)["neighbors"]
    assert (neighbor["name"], neighbor["signal_dbm"]) == ("02:00:00:00:00:02", -63)
    problem = "no radio is known by name: run `meshctl status`, then `meshctl robots deploy`"
    eventually(lambda: _radio(fleet).get("problem") == problem)

    # a MAC of the inventory is configuration: the collector restarts, and the daemon keeps its messages
    text = fleet.file.read_text()
    named = "rear: {address: 10.42.0.9, radios: {radio0: {mac: '02:00:00:00:00:02'}}}"
    fleet.file.write_text(text.replace("rear: {address: 10.42.0.9}", named))
    before = fleet.shell("husky1", "systemctl show -p MainPID udp-mesh")
    fleet.deploy("husky1")
    assert fleet.shell("husky1", "systemctl show -p MainPID udp-mesh") == before
    eventually(lambda: [peer["name"] for peer in _conditions(fleet)["peers"] if peer["radio"]] == ["husky2"])
    path = _conditions(fleet)["peers"][0]["radio"]
    assert (path["radio"], path["next_hop"], path["signal_dbm"]) == ("base", "rear", -63)

    # killed, it comes back; without the setting the next deploy removes it, and the radio's key goes with it
    fleet.shell("husky1", "systemctl kill -s KILL udp-mesh-collector")
    eventually(lambda: fleet.shell("husky1", "systemctl is-active udp-mesh-collector || true").strip() == "active")
    fleet.file.write_text(fleet.file.read_text().replace("collector: true", "collector: false"))
    fleet.deploy("husky1")
    assert fleet.shell("husky1", "ls /etc/systemd/system").count("udp-mesh-collector") == 0
    fleet.root_command("render", "base", "--out", str(fleet.directory / "build"))
    assert key not in (built / "etc/dropbear/authorized_keys").read_text()
    assert not (built / LINKS_PATH).exists()
