"""The guide on thin links: its configuration runs on two daemons over a modeled radio, and its commands work.

Only the ports, and the duty cycle, are others: with 1 % a test would wait for airtime.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.udp_mesh.daemon.meshtastic_air import MeshtasticAir
from tests.udp_mesh.daemon.processes import KEY, RunningDaemon, collect, poll
from tests.udp_mesh.daemon.serial_air import SerialAir, running
from tests.udp_mesh.daemon.xbee_air import XBeeAir
from tests.udp_mesh.links.sockets import WAIT_S, free_port
from udp_mesh.core.thin.lora import PRESETS

GUIDE = Path(__file__).parents[3] / "docs" / "how-to" / "thin-links.md"


def udp_mesh(daemon: RunningDaemon, *words: str) -> str:
    command = [sys.executable, "-m", "udp_mesh.cli.main", *words, "--socket", str(daemon.socket)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=True)
    return done.stdout


@pytest.mark.parametrize("radio", ["transparent", "XBee", "Meshtastic"])
def test_the_configuration_of_the_guide_carries_a_stop_to_a_robot_without_wifi(radio: str) -> None:
    text = GUIDE.read_text(encoding="utf-8")
    block, xbee, meshtastic = re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    if radio != "transparent":
        block = block[: block.index("[[thin.links]]")] + (xbee if radio == "XBee" else meshtastic)
    [device] = re.findall(r'^device = "(.*)"', block, re.MULTILINE)
    [duty_cycle] = re.findall(r"^duty_cycle = [\d.]+", block, re.MULTILINE)
    [publish] = re.findall(r"^\$ udp-mesh (pub .*)$", text, re.MULTILINE)
    radios: SerialAir
    if radio == "Meshtastic":
        [preset] = re.findall(r'^preset = "(.*)"', block, re.MULTILINE)
        radios = MeshtasticAir(2, bits_per_s=PRESETS[preset].bits_per_s)
    else:
        [rate] = map(float, re.findall(r"^bits_per_s = (\d+)", block, re.MULTILINE))
        radios = XBeeAir(2, bits_per_s=rate, escaped=True) if radio == "XBee" else SerialAir(2, bits_per_s=rate)
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, running(radios) as air:
        folder, port = Path(path), free_port()
        (folder / "fleet.key").write_text(KEY)
        daemons = []
        for number, name in enumerate(("base", "husky1"), 1):
            own = block.replace('"base"', f'"{name}"').replace("number = 1", f"number = {number}")
            own = own.replace(device, air.devices[number - 1]).replace(duty_cycle, "duty_cycle = 0.5")
            # No wifi: a link without other nodes.
            alone = f'\n[[links]]\naddress = "127.0.3.{number}"\nkind = "neighbours"\n'
            more = f'[daemon]\nsocket = "{folder / name}.sock"\nstate_directory = "{folder / name}"\n'
            daemons.append(RunningDaemon(folder, name, f"port = {port}\n{own}{alone}{more}"))
        base, husky = daemons
        with base, husky:
            for daemon in daemons:
                poll(
                    lambda daemon=daemon: "ONLY HERE" in udp_mesh(daemon, "status") or None,  # type: ignore[misc]
                    f"{daemon.name} hears the other",
                )
            # before the stop: one that is lost beside the stop's acknowledgment is sent again only 30 s later
            udp_mesh(husky, "set", "position", "1", "2")
            poll(lambda: re.search(r"husky1 +1\.0 +2\.0", udp_mesh(base, "status")), "husky1's position arrives")
            with husky.client() as robot:
                robot.request("subscribe", topics=["estop"])
                udp_mesh(base, *publish.split())
                [message] = collect(robot, 1)
            assert message.payload == b"stop"
