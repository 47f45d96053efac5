"""Small mistakes of real inventories: each is found, at the place that is wrong, and what is sound beside it is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.lint.openwrt_names import suggest_packages
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
_GATEWAY = """
    nodes: {base: {extra_uci: {network.wan: interface, network.wan.device: eth1, network.wan.proto: dhcp,
      firewall.wan: zone, firewall.wan.name: wan, firewall.wan.network: wan, firewall.wan.input: REJECT,
      firewall.out: forwarding, firewall.out.src: management, firewall.out.dest: wan, MORE}}}
    """


def _found(fragment: str, directory: Path) -> list[Diagnostic]:
    example = Example(fragment)
    return list(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


@pytest.mark.parametrize(
    ("fragment", "code", "path", "expected"),
    [
        ("meshes: {main: {ssid: 'fle\u200bet'}}", "MC005", "", "characters that can be seen"),
        ("meshes: {main: {ssid: my\u00a0fleet}}", "MC005", "", "characters that can be seen"),
        (
            "topics: {commands: {destinations: [husky1, husky1]}}",
            "MC006",
            "topics.commands.destinations.1",
            "each value",
        ),
        (
            "hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, iw, wpad-openssl]}}",
            "MC006",
            "hardware.rocket.packages.3",
            "each value once",
        ),
        ("nodes: {husky1-front: {role: beacon}}", "MC610", "nodes.husky1-front.role", "role: robot"),
        ("nodes: {husky1-front: {role: <removed>}}", "MC610", "nodes.husky1-front", "role: robot"),
        (
            "robots: {husky1: {computer: {ssh: {user: robot@10.42.0.110}}}}",
            "MC434",
            "robots.husky1.computer.ssh.user",
            "user: robot, host: 10.42.0.110",
        ),
        ("topics: {commands: {type: std_msg/String}}", "MC726", "topics.commands.type", "std_msgs/String"),
        ("topics: {commands: {type: std_msg/msg/String}}", "MC726", "topics.commands.type", "std_msgs/msg/String"),
        ("hardware: {rocket: {target: ar71xx/generic}}", "MC833", "hardware.rocket.target", "ath79/generic"),
        ("udp_mesh: {heartbeat_s: 1000, offline_after_s: 10}", "MC739", "udp_mesh.heartbeat_s", "at least 3000 s"),
        ("udp_mesh: {heartbeat_s: 5, offline_after_s: 10}", "MC739", "udp_mesh.offline_after_s", "at least 15 s"),
        (
            "hardware: {rocket: {radios: {radio0: {antenna: sector}}}}",
            "MC348",
            "hardware.rocket.radios.radio0.antenna",
            "less than 360",
        ),
    ],
)
def test_a_mistake_is_found_at_its_place(fragment: str, code: str, path: str, expected: str, tmp_path: Path) -> None:
    (finding,) = [item for item in _found(fragment, tmp_path) if item.code == code]
    assert finding.path == path
    assert finding.expected.startswith(expected)


@pytest.mark.parametrize(
    "fragment",
    [
        # French typography, and a joiner of a word
        "hardware: {rocket: {recovery: 'Attendre 8\u00a0s, puis TFTP\u00a0: 192.168.1.20'}}",
        "nodes: {b01: {label: '\u0645\u06cc\u200c\u062e'}}",
        "topics: {commands: {type: std_msgs/msg/String}}",
        "topics: {commands: {type: my_std_msgs/String}}",
        "hardware: {rocket: {target: ar71xx/generic, release: '19.07'}}",
        "robots: {base-station: {nodes: [base]}}",
        _GATEWAY.replace("MORE", "network.globals: globals, network.globals.ula_prefix: 'fd42:80::/48'"),
        _GATEWAY.replace("MORE", "network.globals: globals, network.globals.ula_prefix: auto"),
    ],
)
def test_what_is_sound_is_not_reported(fragment: str, tmp_path: Path) -> None:
    codes = {item.code for item in _found(fragment, tmp_path)}
    assert not codes & {"MC005", "MC006", "MC434", "MC610", "MC726", "MC833", "MC918", "MC921"}


@pytest.mark.parametrize(
    ("key", "value", "code"),
    [
        ("network.globals", "globasl", "MC918"),
        ("network.globals.ula_prefix", "df42:80::/48", "MC918"),
        ("network.globals.ula_prefix", "fd42:80::1/48", "MC918"),
        ("firewall.out.src", "", "MC921"),
        ("firewall.out.dest", "", "MC921"),
        ("firewall.wan.name", "", "MC921"),
        ("network.far", "route", "MC921"),
        ("dhcp.guests", "dhcp", "MC921"),
    ],
)
def test_a_gateway_that_lacks_something_is_reported(key: str, value: str, code: str, tmp_path: Path) -> None:
    globals_ = {"network.globals": "globals", "network.globals.ula_prefix": "fd42:80::/48"}
    further = {"network.far": {"network.far.target": "10.9.0.0/24"}, "dhcp.guests": {"dhcp.guests.start": "20"}}
    extra = {**globals_, **further.get(key, {}), key: value}
    written = ", ".join(f"{name}: '{text}'" for name, text in extra.items())
    fragment = (
        _GATEWAY.replace("firewall.out.src: management, firewall.out.dest: wan, MORE", "MORE")
        if (key.startswith("firewall.out"))
        else _GATEWAY.replace("firewall.wan.name: wan, ", "")
        if key == "firewall.wan.name"
        else _GATEWAY
    )
    assert code in {item.code for item in _found(fragment.replace("MORE", written), tmp_path)}


def test_a_kernel_module_whose_name_was_cut_is_a_typo() -> None:
    assert suggest_packages("kmod-batman") == ("kmod-batman-adv",)
    # several modules, or none, begin like this
    assert suggest_packages("kmod-ath10k-c") == ("kmod-ath10k-ct",)
    assert suggest_packages("kmod-usb") == ()
    assert suggest_packages("odhcpd") == ()
