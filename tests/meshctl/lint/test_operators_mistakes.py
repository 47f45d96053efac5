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


_REPORTED_HERE = (
    *("MC005", "MC006", "MC122", "MC214", "MC238", "MC434", "MC435"),
    *("MC610", "MC726", "MC833", "MC837", "MC918", "MC921"),
)


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
        ("system: {timezone: CET-1CEST, zonename: Europe/Oslo}", "MC238", "country", "NO"),
        ("system: {timezone: 'CET-1CEST,M3.5.0,M10.5.0/3'}", "MC238", "country", "the country where"),
        ("system: {timezone: 'IST-5:30', zonename: Asia/Kolkata}", "MC238", "country", "IN"),
        ("system: {log_size_kib: 16384}", "MC239", "system.log_size_kib", "at most 8192"),
        ("system: {log_host: 10.42.0.100, log_port: 123}", "MC737", "system.log_port", "the log server's port"),
        ("udp_mesh: {metrics_port: 39105}", "MC741", "udp_mesh.metrics_port", "1024 to 32767"),
        ("udp_mesh: {heartbeat_s: 0.05}", "MC742", "udp_mesh.heartbeat_s", "at least 0.1 s"),
        ("nodes: {base: {label: b1}}", "MC116", "nodes.b01.label", "a unique label"),
        ("nodes: {base: {label: husky1}}", "MC122", "nodes.base.label", "a label that is no other"),
        ("nodes: {husky1-front: {role: base}}", "MC610", "nodes.husky1-front.role", "role: robot"),
        ("sites: {north: {ssh: {host: gw north}}}", "MC435", "sites.north.ssh.host", "an address such as"),
        ("hardware: {rocket: {flash_mib: 8192}}", "MC837", "hardware.rocket.flash_mib", "at most 1024"),
        ("nodes: {b01: {ssh: {host: 10.42.0.1}}}", "MC214", "nodes.b01.ssh.host", "a unique host and port"),
        (
            "robots: {husky1: {computer: {ssh: {host: 10.42.0.100}}}}",
            "MC214",
            "robots.husky1.computer.ssh.host",
            "a unique host and port",
        ),
        ("topics: {estop: {sources: [husky1]}}", "MC727", "topics.estop.sources", "base-station"),
        ("topics: {video: {deadline_s: 0.002}}", "MC728", "topics.video.deadline_s", "at least 0.02 s"),
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
        # the robot's own name on its radio, in either case, and the node's own
        "nodes: {husky1-front: {label: HUSKY1}, b01: {label: B01}}",
        # the same clock in a neighboring country, another name of the zone, and one without a country
        "country: NO\nsystem: {timezone: 'CET-1CEST,M3.5.0,M10.5.0/3', zonename: Europe/Berlin}",
        "system: {timezone: 'EST5EDT,M3.2.0,M11.1.0', zonename: US/Eastern}",
        "country: DE\nsystem: {timezone: 'CET-1CEST,M3.5.0,M10.5.0/3', zonename: CET}",
        "system: {timezone: UTC+2}",
        "hardware: {rocket: {target: x86/64, memory_mib: 4096, flash_mib: 16384}}",
        "robots: {husky1: {computer: {ssh: {host: 'fe80::1%eth0'}}}}",
        "robots: {husky1: {computer: {ssh: {host: 10.42.0.100, port: 2222}}}}",
        _GATEWAY.replace("MORE", "network.globals: globals, network.globals.ula_prefix: 'fd42:80::/48'"),
        _GATEWAY.replace("MORE", "network.globals: globals, network.globals.ula_prefix: auto"),
    ],
)
def test_what_is_sound_is_not_reported(fragment: str, tmp_path: Path) -> None:
    codes = {item.code for item in _found(fragment, tmp_path)}
    assert codes.isdisjoint(_REPORTED_HERE)


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
