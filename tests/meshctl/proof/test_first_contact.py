"""A device fresh from its box, taken in over SSH: no operator is locked out, and what its board wrote stays."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs")]

# What config_generate writes on a board whose ports are behind a switch, and a radio that the inventory leaves out.
BOARD = """
uci add network switch
uci set network.@switch[0].name=switch0
uci set network.@switch[0].enable_vlan=1
uci add network switch_vlan
uci set network.@switch_vlan[0].device=switch0
uci set network.@switch_vlan[0].vlan=1
uci set network.@switch_vlan[0].ports='3 0t'
uci set system.led_lan=led
uci set system.led_lan.trigger=switch0
uci set wireless.radio7=wifi-device
uci set wireless.radio7.path=pci0000:00/0000:00:07.0
uci set wireless.radio7.disabled=1
uci commit
sync
"""


def test_bootstrap_requires_an_authorized_key_and_keeps_the_board_configuration(tmp_path: Path) -> None:
    with Rig(tmp_path / "rig", 1) as rig:
        rig.wait_all_up()
        node = rig.fleet.node("n001")
        node.exec(BOARD).check("write as the board does")
        before = node.exec("cat /etc/config/*").stdout
        key = rig.directory / "key"
        right = key.read_bytes()
        key.write_bytes(
            Ed25519PrivateKey.generate().private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH, serialization.NoEncryption()
            )
        )
        refused = rig.meshctl("bootstrap", "a", "n001", "--yes", "--json")
        assert refused.results == {"n001": "refused"}, refused.out + refused.err
        assert "you could not log in to it afterwards" in refused.out
        assert node.exec("cat /etc/config/*").stdout == before
        key.write_bytes(right)
        taken = rig.meshctl("bootstrap", "a", "n001", "--yes", "--json")
        assert taken.results == {"n001": "done"}, taken.out + taken.err
        assert node.exec("uci get network.@switch_vlan[0].ports; uci get system.led_lan.trigger").stdout.split(
            "\n"
        ) == [
            "3 0t",
            "switch0",
            "",
        ]
        assert node.exec("uci get wireless.radio7.disabled").stdout == "1\n"
        node.reboot()
        again = rig.meshctl("provision", "a", "n001", "--check", "--json")
        assert again.verdicts == {"n001": "same"}, again.out
