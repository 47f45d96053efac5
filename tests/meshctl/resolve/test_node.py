"""Intent: meshes grouped, the bridge put together, and what no file can hold refused at its place."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Interface, IPv4Network
from typing import Any

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.model import (
    Backend,
    Band,
    Batman,
    Encryption,
    Fleet,
    MeshMode,
    OperatorParts,
    Operators,
    Radio,
    Release,
    Secret,
    SecretRef,
    SshSettings,
    SystemSettings,
)
from meshctl.resolve import Intent, resolve
from tests.meshctl.render import fleets

JOINED = (Radio(fleets.RADIO_2G, "main", 27), Radio(fleets.RADIO_5G, "main", 20))
BOTH = (Radio(fleets.RADIO_2G, "main", 27), Radio(fleets.RADIO_5G, "wide", 20))


def intent(fleet: Fleet) -> Intent:
    return resolve(fleet, next(iter(fleet.nodes.values())), fleets.secrets)


def refusals(fleet: Fleet, secret: str = fleets.KEY) -> list[str]:
    with pytest.raises(InvalidInput) as caught:
        resolve(fleet, next(iter(fleet.nodes.values())), lambda _: Secret(secret))
    assert all(item.position.file == "fleet.yaml" for item in caught.value.diagnostics)
    assert secret not in str(caught.value)
    return [f"{item.path} {item.code}" for item in caught.value.diagnostics]


def test_two_radios_of_one_mesh_share_one_batman_interface() -> None:
    found = intent(fleets.fleet(fleets.node(radios=JOINED)))
    assert [(item.name, item.master) for item in found.interfaces] == [("mesh0", "bat0"), ("mesh1", "bat0")]
    assert [item.name for item in found.batman] == ["bat0"]
    assert found.lan.ports == ("eth0.1", "bat0")


def test_meshes_of_one_network_share_a_batman_interface_and_shortest_interval() -> None:
    wide = fleets.mesh(name="wide", band=Band.G5, channel=36, reconnect_s=1.5)
    found = intent(fleets.fleet(fleets.node(radios=BOTH), meshes=(fleets.mesh(), wide)))
    assert [(item.mesh, item.master) for item in found.interfaces] == [("main", "bat0"), ("wide", "bat0")]
    assert [(item.mesh, item.orig_interval_ms) for item in found.batman] == [("main", 250)]


def test_a_mesh_of_another_network_is_not_bridged() -> None:
    wide = fleets.mesh(name="wide", network=IPv4Network("10.43.0.0/24"))
    found = intent(fleets.fleet(fleets.node(radios=BOTH), meshes=(fleets.mesh(), wide)))
    assert [item.master for item in found.interfaces] == ["bat0", "bat1"]
    assert found.lan.ports == ("eth0.1", "bat0")


def test_the_mesh_that_contains_the_node_address_is_bridged() -> None:
    wide = fleets.mesh(name="wide", network=IPv4Network("10.43.0.0/24"), lan_mtu=1400)
    node = fleets.node(radios=BOTH, address=IPv4Interface("10.43.0.5/24"))
    found = intent(fleets.fleet(node, meshes=(fleets.mesh(), wide)))
    assert found.lan.ports == ("eth0.1", "bat1")
    assert found.lan.mtu == 1400


def test_meshes_with_different_operator_parts_are_refused_with_the_part_that_differs() -> None:
    def parts(interface: str) -> OperatorParts:
        return OperatorParts(service="meshmerize", interface=interface)

    main = fleets.mesh(backend=Backend.MESHMERIZE, operator_parts=parts("mesh0"))
    wide = fleets.mesh(name="wide", backend=Backend.MESHMERIZE, operator_parts=parts("mesh1"))
    with pytest.raises(InvalidInput, match=r"one `operator_parts\.interface` .*, found main: mesh0, wide: mesh1"):
        intent(fleets.fleet(fleets.node(radios=BOTH), meshes=(main, wide)))
    batman = fleets.mesh(name="wide", band=Band.G5, channel=36)
    with pytest.raises(InvalidInput, match="meshes of one back end, found main: meshmerize, wide: batman-adv"):
        intent(fleets.fleet(fleets.node(radios=BOTH), meshes=(main, batman)))


def test_a_node_without_a_mesh_keeps_its_lan_ports() -> None:
    found = intent(fleets.fleet(fleets.node(radios=(Radio(fleets.RADIO_2G, None, 20),))))
    assert found.batman == ()
    assert found.lan.ports == ("eth0.1",)
    assert found.packages == ()


def test_the_elp_interval_is_set_only_for_batman_v() -> None:
    five = fleets.mesh(batman=Batman(routing_algo="BATMAN_V"), reconnect_s=1.4)
    assert [item.elp_interval_ms for item in intent(fleets.fleet(meshes=(five,))).interfaces] == [125]
    assert [item.elp_interval_ms for item in intent(fleets.fleet()).interfaces] == [None]


def test_an_open_mesh_asks_for_no_secret() -> None:
    def none(ref: SecretRef) -> Secret:
        raise AssertionError(ref)

    fleet = fleets.fleet(meshes=(fleets.mesh(key=fleets.KEY_REF),))
    assert resolve(fleet, fleets.node(), none).secrets == ()


def test_a_missing_secret_is_reported_at_its_position() -> None:
    def none(ref: SecretRef) -> Secret:
        raise InputError(f"secret {ref}: not set", hint="export MESH_KEY")

    fleet = fleets.fleet(meshes=(fleets.mesh(encryption=Encryption.PSK2),))
    with pytest.raises(InvalidInput, match=r"fleet\.yaml:10:3: meshes\.main\.key: secret env:MESH_KEY: not set"):
        resolve(fleet, fleets.node(), none)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"ssid": ""}, "meshes.main.ssid RND001"),
        ({"ssid": "x" * 33}, "meshes.main.ssid RND001"),
        ({"ssid": "é" * 17}, "meshes.main.ssid RND001"),
        ({"ssid": "two\nlines"}, "meshes.main.ssid RND001"),
        ({"bssid": "02:ca"}, "meshes.main.bssid RND001"),
        ({"htmode": "HT20; reboot"}, "meshes.main.htmode RND001"),
        ({"batman": Batman(routing_algo="BATMAN IV")}, "meshes.main.batman.routing_algo RND001"),
        ({"batman": Batman(gw_mode="$(reboot)")}, "meshes.main.batman.gw_mode RND001"),
        ({"encryption": Encryption.SAE}, "meshes.main.encryption RND002"),
        ({"encryption": Encryption.PSK2, "mode": MeshMode.MESH}, "meshes.main.encryption RND002"),
        ({"encryption": Encryption.PSK2, "key": None}, "meshes.main.key RND002"),
        ({"reconnect_s": 0.1}, "meshes.main.reconnect_s RND004"),
    ],
)
def test_an_invalid_mesh_is_rejected(changes: dict[str, Any], found: str) -> None:
    assert refusals(fleets.fleet(meshes=(fleets.mesh(**changes),))) == [found]


@pytest.mark.parametrize(
    ("key", "mode", "encryption"),
    [
        ("seven77", MeshMode.ADHOC, Encryption.PSK2),
        ("x" * 65, MeshMode.ADHOC, Encryption.PSK2),
        ("schlüssel-wort", MeshMode.ADHOC, Encryption.PSK2),
        ("two\nlines of key", MeshMode.MESH, Encryption.SAE),
        ("y" * 129, MeshMode.MESH, Encryption.SAE),
    ],
)
def test_a_key_invalid_for_the_encryption_is_rejected_without_being_shown(
    key: str, mode: MeshMode, encryption: Encryption
) -> None:
    fleet = fleets.fleet(meshes=(fleets.mesh(mode=mode, encryption=encryption),))
    assert refusals(fleet, key) == ["meshes.main.key RND001"]


def test_openwrt_25_12_rejects_encrypted_ad_hoc_and_quotes_in_names_or_keys() -> None:
    node = fleets.node(Release.V25_12)
    encrypted = fleets.fleet(node, meshes=(fleets.mesh(encryption=Encryption.PSK2),))
    assert refusals(encrypted) == ["meshes.main.encryption RND002"]
    assert refusals(fleets.fleet(node, meshes=(fleets.mesh(ssid="bob's"),))) == ["meshes.main.ssid RND001"]
    sae = fleets.mesh(mode=MeshMode.MESH, encryption=Encryption.SAE)
    assert refusals(fleets.fleet(node, meshes=(sae,)), "bob's key") == ["meshes.main.key RND001"]
    assert intent(fleets.fleet(fleets.node(Release.V24_10), meshes=(fleets.mesh(ssid="bob's"),))).node


def test_openwrt_25_12_rejects_a_tx_power_of_0_dbm() -> None:
    quiet = (Radio(fleets.RADIO_2G, "main", 0),)
    assert refusals(fleets.fleet(fleets.node(Release.V25_12, radios=quiet))) == [
        "nodes.husky1-front.radios.radio0.tx_power_dbm RND001"
    ]
    assert intent(fleets.fleet(fleets.node(Release.V24_10, radios=quiet))).radios[0].tx_power_dbm == 0


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"hostname": "under_score"}, "nodes.husky1-front.hostname RND001"),
        ({"hostname": "-x"}, "nodes.husky1-front.hostname RND001"),
        ({"label": "two\nlines"}, "nodes.husky1-front.label RND001"),
        ({"lan_ports": ("eth0", "eth 1")}, "nodes.husky1-front.lan_ports.1 RND001"),
        ({"lan_ports": ("a" * 16,)}, "nodes.husky1-front.lan_ports.0 RND001"),
        ({"extra_uci": {"../x.y.z": "1"}}, "nodes.husky1-front.extra_uci.../x.y.z RND001"),
        ({"extra_uci": {"x": "1"}}, "nodes.husky1-front.extra_uci.x RND001"),
        (
            {"radios": (Radio(replace(fleets.RADIO_2G, path=""), "main", 20),)},
            "hardware.wpj344.radios.radio0.path RND001",
        ),
        (
            {"radios": (Radio(replace(fleets.RADIO_2G, name="radio-0"), "main", 20),)},
            "hardware.wpj344.radios.radio-0 RND001",
        ),
    ],
)
def test_an_invalid_node_is_rejected(changes: dict[str, Any], found: str) -> None:
    assert refusals(fleets.fleet(fleets.node(**changes))) == [found]


@pytest.mark.parametrize(
    ("system", "found"),
    [
        (SystemSettings(timezone=""), "system.timezone RND001"),
        (SystemSettings(log_host="10.0.0.1\n"), "system.log_host RND001"),
        (SystemSettings(ntp_servers=("a", "")), "system.ntp_servers.1 RND001"),
    ],
)
def test_empty_or_multi_line_system_settings_are_rejected(system: SystemSettings, found: str) -> None:
    assert refusals(fleets.fleet(system=system)) == [found]


@pytest.mark.parametrize(
    ("release", "keys"),
    [(Release.V24_10, ()), (Release.V19_07, (fleets.ED25519,))],
)
def test_without_a_usable_operator_key_password_login_is_required(release: Release, keys: tuple[str, ...]) -> None:
    fleet = fleets.fleet(fleets.node(release), operators=Operators(keys))
    assert refusals(fleet) == ["operators.ssh_keys RND003"]
    assert intent(replace(fleet, operators=Operators(keys, password_login=True))).login.is_password_allowed


@pytest.mark.parametrize(
    ("ssh", "port"), [(SshSettings(), 22), (SshSettings(port=2222), 2222), (SshSettings(host="gate", port=10022), 22)]
)
def test_dropbear_listens_on_the_ssh_port_unless_another_host_forwards_it(ssh: SshSettings, port: int) -> None:
    assert intent(fleets.fleet(fleets.node(ssh=ssh))).login.port == port


def test_an_invalid_country_is_rejected() -> None:
    assert refusals(fleets.fleet(country="U S")) == ["country RND001"]


def test_multi_line_and_invalid_ssh_keys_are_rejected() -> None:
    fleet = fleets.fleet(operators=Operators((fleets.RSA, "ssh-rsa AAAA a\nssh-rsa BBBB b", "no key")))
    assert refusals(fleet) == ["operators.ssh_keys.1 RND001", "operators.ssh_keys.2 RND001"]


def test_two_mesh_backends_on_one_node_are_rejected() -> None:
    wide = fleets.mesh(name="wide", backend=Backend.MESHMERIZE)
    fleet = fleets.fleet(fleets.node(radios=BOTH), meshes=(fleets.mesh(), wide))
    assert refusals(fleet) == ["nodes.husky1-front.radios RND002"]


def test_every_refusal_is_reported_not_only_the_first() -> None:
    mesh = fleets.mesh(ssid="", bssid="x", reconnect_s=0.1)
    fleet = fleets.fleet(fleets.node(hostname="_"), meshes=(mesh,), operators=Operators())
    assert len(refusals(fleet)) == 5
