"""SSH over IPv6 to real dropbear: a unique local address, and a link-local one with its interface."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from ipaddress import ip_address
from pathlib import Path

from meshctl.device.connection import Credentials, Endpoint
from meshctl.device.ssh import connect
from meshctl.device.trust import TrustStore
from meshctl.nodes.connections import ConnectionPool
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import (
    PATIENT,
    authorize,
    dropbear,
    give_dropbear,
    host_key,
    keypair,
    public,
)
from tests.meshctl.inventory.inventories import HEAD, load_text

_PORT = 2222
_FLEET = (
    HEAD.replace("10.42.0.0/24", "fd42::/64")
    + f"""nodes:
  b01: {{hardware: rocket, address: "fd42::11", ssh: {{port: {_PORT}}}}}
  b02: {{hardware: rocket, address: "fd42::12", ssh: {{host: "fe80::11%mesh0", port: {_PORT}}}}}
"""
)


def test_a_node_is_reached_at_its_ipv6_address_and_at_a_link_local_one() -> None:
    command = ["unshare", "--net", sys.executable, "-m", __name__]
    played = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert played.returncode == 0, played.stdout + played.stderr
    assert played.stdout.splitlines() == [f"b01 fd42::11 {_PORT} up", f"b02 fe80::11%mesh0 {_PORT} up", "[fd42::11]"]


def _play(directory: Path) -> None:
    """In a network namespace of its own, where mesh0 has both addresses."""
    for words in (
        "link set lo up",
        "link add mesh0 type veth peer name wire",
        "link set wire up",
        "link set mesh0 up",
        "addr add fd42::11/64 dev mesh0 nodad",
        "addr add fe80::11/64 dev mesh0 nodad",
    ):
        subprocess.run(["ip", *words.split()], check=True)
    fleet = load_text(directory, _FLEET).fleet
    assert fleet is not None
    node = Sandbox(directory / "node")
    give_dropbear(node)
    key = keypair(directory / "operator")
    authorize(node, public(key))
    trust = TrustStore(directory / "known_hosts")
    for name in fleet.nodes:
        trust.replace(name, host_key(node))
    with (
        dropbear(node, "-p", f"[::]:{_PORT}"),
        ConnectionPool(fleet, trust, key_files=(key,), use_agent=False, deadlines=PATIENT) as pool,
    ):
        for name, one in fleet.nodes.items():
            where = pool.endpoint(one)
            with pool.borrow(one) as connection:
                said = connection.run("echo up").stdout.strip()
                sys.stdout.write(f"{name} {where.host} {where.port} {said}\n")
        # a pin by address, without an identity, as `meshctl bootstrap` makes for a device on the bench
        bare = Endpoint(str(ip_address("fd42::11")), _PORT)
        trust.replace(bare.pin_name, host_key(node))
        with connect(bare, credentials=Credentials(key_files=(key,), use_agent=False), trust=trust, deadlines=PATIENT):
            pinned = (directory / "known_hosts").read_text().splitlines()[-1]
            sys.stdout.write(pinned.partition(":2222")[0])


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        _play(Path(name))
