"""Which radio interfaces a supplicant runs: by its control sockets, and on the bus where netifd deleted one."""

from __future__ import annotations

import pytest

from meshctl.device.observe import observe
from meshctl.device.ssh import SshConnection
from tests.meshctl.device.sandbox import Sandbox

UBUS = """#!/bin/sh
[ "$1 $2" = 'list wpa_supplicant.*' ] || exit 4
echo asked >>/tmp/asked
[ ! -e /tmp/on-the-bus ] || { cat /tmp/on-the-bus && exit; }
echo 'Command failed: Not found' >&2
exit 4
"""


# the file that hostapd.sh writes for an interface of the supplicant, and 25.12's supplicant.uc
@pytest.mark.parametrize("file", ["/var/run/wpa_supplicant-mesh0.conf", "/var/run/wpa-supplicant-mesh0.conf"])
def test_a_supplicant_whose_socket_was_deleted_is_found_on_the_bus(
    connection: SshConnection, node: Sandbox, file: str
) -> None:
    """24.10.7: netifd's scripts delete the socket of an interface that they set up once more (hostapd.sh)."""
    node.put("/var/run/wpa_supplicant/global", "")
    node.put(file, "network={\n}\n")
    node.put("/usr/bin/ubus", UBUS, 0o755)
    node.put("/tmp/on-the-bus", "wpa_supplicant.mesh0\n")
    assert observe(connection).supplicants == ("global", "mesh0")


def test_an_interface_that_no_supplicant_runs_is_not_unknown(connection: SshConnection, node: Sandbox) -> None:
    """`ubus list` fails for it. None would mean that nothing is known, and a proof would not look at encryption."""
    node.put("/var/run/wpa_supplicant/.keep", "")
    node.put("/var/run/wpa_supplicant-mesh0.conf", "network={\n}\n")
    node.put("/usr/bin/ubus", UBUS, 0o755)
    assert observe(connection).supplicants == ()
    assert node.text("/tmp/asked") == "asked\n"


@pytest.mark.parametrize("socket", ["global", "mesh0"])
def test_the_bus_is_asked_only_for_an_encrypted_interface_without_a_socket(
    connection: SshConnection, node: Sandbox, socket: str
) -> None:
    """wpad's own directory is there on open meshes too."""
    node.put(f"/var/run/wpa_supplicant/{socket}", "")
    if socket != "global":
        node.put("/var/run/wpa_supplicant-mesh0.conf", "network={\n}\n")
    node.put("/usr/bin/ubus", UBUS, 0o755)
    assert observe(connection).supplicants == (socket,)
    assert node.text("/tmp/asked") is None
