"""A site whose gateway is a Debian machine with a real systemd: the worker is a unit of its login user.

The leaf node there is Debian's own unit with the configuration of the guide. The nodes are virtual, and reached from
the gateway at their own addresses; the operator, the hub and the uplink, which a test can cut, are outside.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
from pathlib import Path

from meshctl.model import NatsHub, SiteNats
from meshctl.sites.service import start_service, unit
from meshlab.addresses import loopback_of
from meshlab.client import request
from tests.meshctl.device.servers import public
from tests.meshctl.inventories import compex_hardware
from tests.meshctl.robots.lan import Lan, in_network
from tests.meshctl.robots.machine import PYTHON, Machine
from tests.meshctl.sites.forwarder import CuttableUplink
from tests.meshctl.sites.nats_servers import NatsServerProcess
from tests.meshctl.sites.rig import FleetRig
from tests.meshctl.sites.wheels import required_wheels

GUIDE = Path(__file__).parents[3] / "docs/how-to/permanent-sites.md"
OPERATOR, ADDRESS = "192.0.2.250", "192.0.2.10"
USER, UID = "mesh", 1000
HOME = f"/home/{USER}"
NODES = {"n-base": "10.42.0.1"}
UNIT = "meshctl-worker-mines-north.service"
INVENTORY = (
    """\
meshctl: 1
fleet: mines
country: US
operators: {{ssh_keys: ["{key}"]}}
hardware:
"""
    + compex_hardware("24.10", confirm_window_s=60)
    + """\
meshes:
  north: {{ssid: north, bssid: "02:ca:fe:00:00:01", band: 2g, channel: 6, network: 10.42.0.0/24}}
nats: {{url: {hub}}}
sites:
  north: {{nats: {{}}, ssh: {{host: {gateway}, user: mesh, key_files: ["{private}"]}}}}
defaults: {{hardware: box, state: deployed, site: north, radios: {{radio0: {{mesh: north}}}}}}
nodes:
  n-base: {{role: base, address: 10.42.0.1}}
"""
)
# libpam-systemd's line of common-session, as its package writes it
_SESSIONS = "session\toptional\tpam_systemd.so\n"


class GatewayRig(FleetRig):
    """Use it in a `with` block, in the network of `lan`: the nodes are bootstrapped, nothing is installed."""

    def __init__(self, directory: Path, lan: Lan, debian: Path) -> None:
        super().__init__(directory)
        self._lan = lan
        self._pins = directory / "pins"
        leafnodes = {"listen": f"{OPERATOR}:7423", "advertise": "127.0.0.1:1"}
        self.hub = NatsServerProcess(directory / "nats", "hub", "hub", {"leafnodes": leafnodes})
        self.uplink = CuttableUplink(7423, OPERATOR, socket.create_server((OPERATOR, 7422)))
        self.machine = Machine(debian, directory / "gateway", lan, ADDRESS, self.key)
        self._ports: list[CuttableUplink] = []
        self._wheels = required_wheels(directory / "wheels", "nats")
        self._prepare()

    def _prepare(self) -> None:
        """What an administrator has done there: a login user, a leaf node as in the guide."""
        machine, upper = self.machine, self.directory / "gateway/upper"
        machine.append(
            "/etc/passwd", f"{USER}:x:{UID}:{UID}::{HOME}:/bin/bash\nnats:x:990:990::/nonexistent:/bin/false\n"
        )
        machine.append("/etc/group", f"{USER}:x:{UID}:\nnats:x:990:\n")
        machine.append("/etc/shadow", f"{USER}:*:19000:0:99999:7:::\nnats:!:19000::::::\n")
        machine.append("/etc/pam.d/common-session", _SESSIONS)
        machine.write(f"{HOME}/.ssh/authorized_keys", public(self.key).read_text(), 0o600)
        for path in (HOME, f"{HOME}/.ssh", f"{HOME}/.ssh/authorized_keys"):
            os.chown(upper / path.lstrip("/"), UID, UID)
        if not PYTHON.startswith("python3"):
            (upper / "usr/local/bin").mkdir(parents=True)
            (upper / "usr/local/bin/python3").symlink_to(PYTHON)
        # the nodes' ports are those of other addresses
        machine.write("/etc/ssh/sshd_config.d/address.conf", f"ListenAddress {ADDRESS}\n")
        machine.write("/etc/nats-server.conf", leaf_configuration(f"nats://north:password@{OPERATOR}:7422"))
        machine.write("/root/set-up", server_commands())

    def _set_up(self) -> None:
        words = {"key": public(self.key).read_text().strip(), "private": self.key, "hub": self.hub.url}
        self.start_lab(INVENTORY.format(gateway=ADDRESS, **words))
        self.run("bootstrap", *NODES, "--yes", "--json", expected=0)
        self.run("lab", "unplug", expected=0)
        port = int(request(self.lab, {"op": "status"})["port"])
        with in_network(self.machine.network):
            for address in NODES.values():
                subprocess.run(["ip", "addr", "add", f"{address}/32", "dev", "lo"], check=True)
            listeners = [socket.create_server((address, 22)) for address in NODES.values()]
        for address, listener in zip(NODES.values(), listeners, strict=True):
            self._ports.append(CuttableUplink(port, loopback_of(address), listener))
        # from now on as in the field: the nodes are reached through their gateway
        self.environment.pop("MESHCTL_LAB")
        self.machine.start()
        self.root("sh -eu /root/set-up")

    def install(self) -> str:
        """What `sites install` prints."""
        return self.run("sites", "install", "--wheels", str(self._wheels), expected=0).out

    def start_unit_again(self) -> str:
        """What `sites install` leaves to the administrator, with nothing to be sent anymore."""
        with self.machine.log_in(self._pins, USER) as connection:
            return start_service(connection, UNIT, unit("mines", "north", SiteNats("north"), NatsHub(self.hub.url)))

    def root(self, command: str) -> str:
        return self.machine.shell(command, self._pins)

    def user(self, command: str) -> str:
        """What a command of the login user prints."""
        with self.machine.log_in(self._pins, USER) as connection:
            return connection.run(command).check(command).stdout

    def close(self) -> None:
        self.environment["MESHCTL_LAB"] = str(self.lab)
        super().close()
        self.machine.stop()
        self.hub.stop()
        for each in (self.uplink, *self._ports):
            each.close()


def leaf_configuration(url: str) -> str:
    """The guide's, with the hub of the tests, which has no TLS."""
    _, configuration = re.findall(r"```\n# /etc/nats-server.conf\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    return re.sub(r'url: "[^"]*", tls \{[^}]*\}', f'url: "{url}"', configuration)


def server_commands() -> str:
    """What the guide lets root do at each server."""
    (commands,) = re.findall(r"```sh\n(install .*?)```", GUIDE.read_text(), re.DOTALL)
    return str(commands)
