"""What a newcomer's trial reported: findings that were false, missing, or at the wrong place."""

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.inventory import load_fleet
from meshctl.inventory.secrets import SecretStore
from meshctl.lint import Example, check_path, trial_rendering
from meshctl.lint.example import ENVIRONMENT, compose, environment, write
from meshctl.lint.openwrt_names import PACKAGES, is_one_edit_apart, suggest_packages
from meshctl.lint.zones import is_posix, zones
from meshctl.nodes.desired import Renderer
from meshctl.regdb import SHIPPED, load
from meshctl.render import Rendered, Templates, render
from meshctl.resolve import Intent

_REGDB = load(SHIPPED)
_KEY = ENVIRONMENT["UDP_MESH_KEY"]


def _found(example: Example | str, directory: Path) -> list[Diagnostic]:
    given = Example(example) if isinstance(example, str) else example
    return list(check_path(write(given, directory), _REGDB, environment(given)).diagnostics)


def _codes(example: Example | str, directory: Path) -> list[str]:
    return [item.code for item in _found(example, directory)]


def test_a_secret_outside_the_repository_is_accepted(tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    (repository / ".git").mkdir(parents=True)
    (tmp_path / "id").write_text(_KEY, encoding="utf-8")
    (tmp_path / "id").chmod(0o600)
    fragment = "{udp_mesh: {keys: [{file: ../id}]}, nodes: {base: {ssh: {key_files: [../id]}}}}"
    assert _codes(fragment, repository) == []


def test_secret_symlinks_are_resolved_before_the_repository_check(tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    (repository / ".git").mkdir(parents=True)
    (tmp_path / "id").write_text(_KEY, encoding="utf-8")
    (tmp_path / "id").chmod(0o600)
    (repository / "id").symlink_to(tmp_path / "id")
    assert _codes("udp_mesh: {keys: [{file: id}]}", repository) == []
    outside = tmp_path / "outside"
    outside.mkdir()
    (repository / "own").write_text(_KEY, encoding="utf-8")
    (repository / "own").chmod(0o600)
    (outside / "link").symlink_to(repository / "own")
    assert _codes("udp_mesh: {keys: [{file: link}]}", outside) == ["MC443"]


def test_a_directory_as_known_hosts_is_reported(tmp_path: Path) -> None:
    (tmp_path / "pins").mkdir()
    (finding,) = _found("operators: {known_hosts: pins}", tmp_path)
    assert (finding.code, finding.message) == ("MC431", "not a regular file")


@pytest.mark.parametrize(
    ("key", "codes"),
    [
        (bytes(range(32)).hex(), ["MC453"]),
        ("ab" * 32, ["MC453"]),
        ("tPjn8MOpTCGh0tmg9cNudyLRtsjj8EpbnH2OHyo7TF0= # 5d3c1a90", []),
        (f"{_KEY}\n{_KEY}", ["MC445"]),
    ],
)
def test_a_transport_key_is_parsed_as_in_udp_mesh(key: str, codes: list[str], tmp_path: Path) -> None:
    example = Example("udp_mesh: {keys: [{file: mode-0600.key}]}", files={"mode-0600.key": key})
    assert _codes(example, tmp_path) == codes


def test_the_same_key_with_and_without_its_id_is_a_duplicate(tmp_path: Path) -> None:
    example = Example(
        "udp_mesh: {keys: [{env: UDP_MESH_KEY}, {file: mode-0600.key}]}", files={"mode-0600.key": f"{_KEY}  # 5d3c1a90"}
    )
    assert _codes(example, tmp_path) == ["MC448"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("udp_mesh: [not, text]\n", "has no entry 'udp_mesh' with text"),
        ("udp-mesh: abc\n", "has no entry 'udp_mesh' with text"),
        ("udp_mesh: {", "is not valid YAML"),
    ],
)
def test_an_available_secret_file_must_contain_the_secret(text: str, found: str, tmp_path: Path) -> None:
    fragment = "udp_mesh: {keys: [{file: mode-0600.yaml, key: udp_mesh}]}"
    (finding,) = _found(Example(fragment, files={"mode-0600.yaml": text}), tmp_path)
    assert finding.code == "MC450"
    assert found in finding.found
    written = compose(Example(fragment)).splitlines()[finding.position.line - 1]
    assert written[finding.position.column - 1 :].startswith("udp_mesh")
    assert "abc" not in repr(finding)


def test_a_directory_is_not_accepted_as_a_secret_file(tmp_path: Path) -> None:
    (tmp_path / "keys").mkdir()
    assert _codes("udp_mesh: {keys: [{file: keys}]}", tmp_path) == ["MC450"]


def _at(finding: Diagnostic, directory: Path) -> str:
    """The inventory's text from the finding's place to the end of its line."""
    lines = (directory / "fleet.yaml").read_text(encoding="utf-8").splitlines()
    return lines[finding.position.line - 1][finding.position.column - 1 :]


_SECOND_CELL = """
meshes:
  main: {backend: meshmerize, operator_parts: PARTS}
  second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.0/24,
           encryption: psk2+ccmp, key: {env: MESH_KEY}, backend: meshmerize, operator_parts: PARTS}
nodes: {base: {radios: {radio1: {mesh: second}}}}
""".replace("PARTS", "{templates: parts, service: mm, interface: mm0, status_command: mm-status, packages: [mm]}")


def test_two_cells_under_one_meshmerize_interface_share_their_network(tmp_path: Path) -> None:
    files = {"parts/etc/config/mm.j2": "config mm\n"}
    assert _codes(Example(_SECOND_CELL, files=files), tmp_path) == []
    other = _SECOND_CELL.replace("interface: mm0", "interface: mm1", 1)
    assert "MC205" in _codes(Example(other, files=files), tmp_path)


@pytest.mark.parametrize(
    ("second", "difference"),
    [
        ("", "main has back end meshmerize, second batman"),
        ("backend: meshmerize, operator_parts: PARTS,", "main has interface mm0, second mm1"),
    ],
)
def test_one_network_for_two_routing_interfaces_is_not_advised_again(
    second: str, difference: str, tmp_path: Path
) -> None:
    """The advice was to use the same network for both, which was what the finding was about."""
    head, _, tail = _SECOND_CELL.rpartition("backend: meshmerize, operator_parts: {")
    parts = "{" + tail.partition("}")[0].replace("mm0", "mm1") + "}"
    text = f"{head}{second.replace('PARTS', parts)}{tail.partition('}')[2].lstrip(', ')}"
    found = _found(Example(text, files={"parts/etc/config/mm.j2": "config mm\n"}), tmp_path)
    (finding,) = [one for one in found if one.code == "MC205"]
    assert difference in finding.text
    assert (finding.expected, finding.found) == ("a separate network", "10.42.0.0/24")


def test_a_missing_folder_of_operator_parts_is_reported_where_the_inventory_names_it(tmp_path: Path) -> None:
    (finding,) = _found(_SECOND_CELL, tmp_path)
    assert (finding.code, finding.found) == ("MC901", "none at parts")
    assert finding.path == "meshes.main.operator_parts.templates"
    assert _at(finding, tmp_path).startswith("parts")


def test_a_folder_of_operator_parts_without_templates_is_reported(tmp_path: Path) -> None:
    (finding,) = _found(Example(_SECOND_CELL, files={"parts/etc/config/mm": "config mm\n"}), tmp_path)
    assert (finding.code, finding.path) == ("MC901", "meshes.main.operator_parts.templates")
    assert finding.expected == "templates below it, such as etc/config/meshmerize.j2"


def test_a_misspelled_back_end_in_the_templates_is_one_finding_among_others(tmp_path: Path) -> None:
    files = {"templates/comon/etc/config/extra.j2": "config led\n"}
    found = _found(Example("apply: {stop_after_failures: 9}", files=files), tmp_path)
    assert [item.code for item in found] == ["MC616", "MC901"]
    assert "found comon" in found[1].text


def test_own_templates_are_rendered_once_for_all_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered = []

    def counted(intent: Intent, templates: Templates) -> Rendered:
        rendered.append(intent.node)
        return render(intent, templates)

    monkeypatch.setattr(trial_rendering, "render", counted)
    files = {"templates/common/etc/config/extra.j2": "config led\n"}
    assert _codes(Example("nodes: {b01: {extra_uci: {firewall.management.input: REJECT}}}", files=files), tmp_path) == [
        "MC902"
    ]
    assert len(rendered) == len(set(rendered)) > 1


def test_a_relay_whose_first_radio_is_in_another_network_may_keep_its_address(tmp_path: Path) -> None:
    """A box whose radio0 is the 2.4 GHz one, with the backbone at 5 GHz."""
    fragment = """
meshes:
  second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
           encryption: psk2+ccmp, key: {env: MESH_KEY}}
nodes:
  base: {radios: {radio1: {mesh: second}}}
  relay: {role: beacon, address: 10.43.0.7, radios: {radio1: {mesh: second}}}
robots: {base-station: {computer: {links: [{address: 10.43.0.100}]}}}
"""
    assert _codes(fragment, tmp_path) == []


_BEHIND_A_ROBOT = """
meshes:
  second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
           encryption: psk2+ccmp, key: {env: MESH_KEY}}
nodes:
  husky1-front: {radios: {radio1: {mesh: second}}}
  b01: {address: 10.43.0.101, SETTINGS radios: {radio0: {mesh: null}, radio1: {mesh: second}}}
"""


@pytest.mark.parametrize(
    ("settings", "codes"),
    [("", ["MC221"]), ("ssh: {host: 192.0.2.1},", []), ("ssh: {jump: husky1-front},", [])],
)
def test_a_mesh_in_whose_network_the_base_station_has_no_address_is_reported(
    settings: str, codes: list[str], tmp_path: Path
) -> None:
    found = _found(_BEHIND_A_ROBOT.replace("SETTINGS", settings), tmp_path)
    assert [item.code for item in found] == codes
    assert all(_at(item, tmp_path).startswith("10.43.0.0/24") for item in found)


_UAV = """
nodes: {uav1-radio: {role: robot, state: carried, address: 10.42.0.60}}
robots:
  uav1: {nodes: [uav1-radio], computer: {address: 10.42.0.61/24, ssh: {user: robot}}}
  husky1: {carries: [b01, uav1-radio]}
"""


def test_a_robot_may_carry_another_robot(tmp_path: Path) -> None:
    assert _codes(_UAV, tmp_path) == []


@pytest.mark.parametrize(
    ("fragment", "code", "text"),
    [
        ("robots: {base-station: {nodes: [base, husky1-front]}}", "MC605", "husky1-front"),
        ("robots: {husky1: {nodes: [base, husky1-front]}}", "MC605", "base"),
        ("robots: {husky1: {nodes: [husky1-front, b01]}}", "MC605", "b01"),
        ("robots: {base-station: {carries: [b01]}}", "MC605", "b01"),
        ("robots: {husky1: {nodes: [husky1-front, absent]}}", "MC103", "absent"),
        ("robots: {husky1: {carries: [b01, 'c[1-2]']}}", "MC104", "c[1-2]"),
        ("robots: {husky1: {carries: [b01, base]}}", "MC607", "base"),
    ],
)
def test_a_finding_in_a_robots_list_points_at_the_element(fragment: str, code: str, text: str, tmp_path: Path) -> None:
    (finding,) = (item for item in _found(fragment, tmp_path) if item.code == code)
    assert _at(finding, tmp_path).strip("- '\"").startswith(text)


def test_a_network_without_any_address_of_its_nodes_is_one_finding_at_the_network(tmp_path: Path) -> None:
    found = [item for item in _found("meshes: {main: {network: 10.24.0.0/24}}", tmp_path) if item.code == "MC202"]
    assert [_at(item, tmp_path) for item in found] == ["10.24.0.0/24"]
    assert found[0].message == "contains no address of base, husky1-front, b01"


@pytest.mark.parametrize(
    ("path", "codes"),
    [
        ("pi0000:00/0000:00:00.0", ["MC843"]),
        ("7", ["MC843"]),
        ("pci0000:00/000:00:00.0", ["MC843"]),
        ("soc/1b500000.pci/pci0001:00/0001:00:00.0/0001:01:00.0", []),
        ("pci0000:00/0000:00:00.0/usb1/1-1/1-1:1.0", []),
        ("platform/soc/18000000.wifi+1", []),
    ],
)
def test_only_paths_that_no_kernel_has_are_reported(path: str, codes: list[str], tmp_path: Path) -> None:
    found = _codes(f"hardware: {{rocket: {{radios: {{radio0: {{path: '{path}'}}}}}}}}", tmp_path)
    assert [code for code in found if code == "MC843"] == codes


def test_each_invalid_list_element_is_a_finding_and_a_range_counts_as_one(tmp_path: Path) -> None:
    found = _found("robots: {husky1: {carries: [b01, x1, 'c[1-9]', x2]}}", tmp_path)
    assert [(item.code, item.found) for item in found] == [
        ("MC104", "x1"),
        ("MC104", "c1, c2, c3, c4 and 5 more"),
        ("MC104", "x2"),
    ]


@pytest.mark.parametrize(
    ("fragment", "place"),
    [
        ("robots: {Husky1: {nodes: [husky1-front]}}", "robots.Husky1"),
        ("nodes: {B01: {address: 10.42.0.99, hostname: other, role: beacon}}", "nodes.B01"),
    ],
)
def test_names_that_differ_only_in_case_are_found_in_every_section(fragment: str, place: str, tmp_path: Path) -> None:
    assert place in [item.path for item in _found(fragment, tmp_path) if item.code == "MC112"]


def test_a_zone_name_as_timezone_suggests_its_posix_string(tmp_path: Path) -> None:
    (finding,) = _found("system: {timezone: America/Denver}", tmp_path)
    assert finding.expected == "MST7MDT,M3.2.0,M11.1.0"
    assert finding.hint == "write `timezone: MST7MDT,M3.2.0,M11.1.0` and `zonename: America/Denver`"
    assert _at(finding, tmp_path) == "America/Denver"


def test_a_misspelled_zone_name_suggests_the_nearest(tmp_path: Path) -> None:
    (finding,) = _found("system: {zonename: America/Dever}", tmp_path)
    assert (finding.code, finding.hint) == ("MC232", "did you mean 'America/Denver'?")


def test_every_zone_of_the_table_has_a_posix_string() -> None:
    assert len(zones()) > 400
    assert [name for name, posix in zones().items() if not is_posix(posix)] == []


@pytest.mark.parametrize("text", ["UTC", "UTC0", "EST5", "<+0330>-3:30", "EST5EDT", "CET-1CEST,M3.5.0,M10.5.0/3"])
def test_valid_posix_time_zones_are_accepted(text: str) -> None:
    assert is_posix(text)


@pytest.mark.parametrize("text", ["", "CET", "Europe/Berlin", "UTC+", "5EST", "CET-1CEST,M3.5.0", "<+03>"])
def test_strings_libc_cannot_parse_are_not_posix_time_zones(text: str) -> None:
    assert not is_posix(text)


@pytest.mark.parametrize(
    ("timezone", "zonename", "codes"),
    [
        ("UTC", "UTC", []),
        ("UTC", "Etc/UTC", []),
        ("GMT0", "UTC", []),
        ("UTC", "America/Denver", ["MC233"]),
        ("MST7MDT,M3.2.0,M11.1.0", "America/Boise", []),
        ("<-07>7<-06>,M3.2.0,M11.1.0", "America/Denver", []),
        ("EST5EDT,M3.2.0,M11.1.0", "America/New York", []),
        ("MST7MDT,M3.2.0,M11.1.0", "UTC", ["MC233"]),
        ("MST7MDT,M3.2.0,M11.1.0", "", []),
    ],
)
def test_timezone_and_zonename_must_agree(timezone: str, zonename: str, codes: list[str], tmp_path: Path) -> None:
    assert _codes(f"system: {{timezone: '{timezone}', zonename: '{zonename}'}}", tmp_path) == codes


def test_a_time_zone_without_a_name_is_not_overridden_by_utc(tmp_path: Path) -> None:
    west = write(Example("system: {timezone: 'MST7MDT,M3.2.0,M11.1.0'}"), tmp_path)
    assert load_fleet(west).system.zonename == ""
    assert load_fleet(write(Example("system: {log_size_kib: 32}"), tmp_path)).system.zonename == "UTC"


@pytest.mark.parametrize(
    ("one", "other"),
    [("abcd", "abd"), ("abcd", "abxcd"), ("abcd", "abxd"), ("abcd", "acbd"), ("abcd", "abcde"), ("abc", "xabc")],
)
def test_one_insertion_deletion_substitution_or_swap_is_one_edit(one: str, other: str) -> None:
    assert is_one_edit_apart(one, other)
    assert is_one_edit_apart(other, one)


@pytest.mark.parametrize(
    ("one", "other"), [("abcd", "abcd"), ("abcd", "ab"), ("abcd", "axyd"), ("abcd", "dcba"), ("", "ab")]
)
def test_zero_or_several_edits_are_not_one_edit(one: str, other: str) -> None:
    assert not is_one_edit_apart(one, other)
    assert not is_one_edit_apart(other, one)


def test_no_known_package_is_flagged_as_a_misspelling() -> None:
    assert [name for name in PACKAGES if suggest_packages(name)] == []


def test_too_small_flash_is_reported_even_without_the_image(tmp_path: Path) -> None:
    image = "{image: absent.bin, revision: r1, sha256: " + "ab" * 32 + "}"
    assert sorted(_codes(f"hardware: {{rocket: {{flash_mib: 4, firmware: {image}}}}}", tmp_path)) == ["MC801", "MC828"]


@pytest.mark.parametrize(("sizes", "codes"), [("flash_mib: 4", ["MC828"]), ("memory_mib: 32", [])])
def test_flash_of_4_mib_is_too_small_for_every_release(sizes: str, codes: list[str], tmp_path: Path) -> None:
    fragment = f'hardware: {{rocket: {{release: "19.07", {sizes}}}}}'
    assert [code for code in _codes(fragment, tmp_path) if code == "MC828"] == codes


@pytest.mark.parametrize("target", ["newchip9000/generic", "ramips/en7581"])
def test_an_unknown_target_unlike_any_known_one_is_accepted(target: str, tmp_path: Path) -> None:
    assert _codes(f"hardware: {{rocket: {{target: {target}}}}}", tmp_path) == []


@pytest.mark.parametrize(
    ("fragment", "code", "hint"),
    [
        ("hardware: {rocket: {target: ath79/genric}}", "MC833", "did you mean 'ath79/generic'?"),
        ("hardware: {rocket: {target: ath97/generic}}", "MC833", "did you mean 'ath79'?"),
        ("robots: {husky1: {computer: {arch: arm64}}}", "MC631", "write aarch64"),
        ("robots: {husky1: {computer: {ros: melodic}}}", "MC632", ""),
        ("nodes: {b01: {packages: [kmod-ath9]}}", "MC832", "did you mean 'kmod-ath9k'?"),
        ("nodes: {b01: {packages: [IW]}}", "MC832", "did you mean 'iw'?"),
    ],
)
def test_a_misspelling_gets_a_suggestion(fragment: str, code: str, hint: str, tmp_path: Path) -> None:
    (finding,) = _found(fragment, tmp_path)
    assert finding.code == code
    assert hint in finding.hint
    assert _at(finding, tmp_path).rstrip("]}").endswith(finding.found)


@pytest.mark.parametrize(
    ("fragment", "code", "text"),
    [
        # base wrote the name; b01 has it because that is what it is called
        ("nodes: {base: {hostname: b01}}", "MC110", "b01"),
        ("nodes: {husky1-front: {hostname: x1}, b01: {hostname: x1}}", "MC110", "x1"),
        ("nodes: {b01: {radios: {radio0: {mac: '00:15:6d:00:00:01'}}}}", "MC113", "00:15:6d:00:00:01"),
        ("udp_mesh: {heartbeat_s: 1000}", "MC739", "1000"),
        ("udp_mesh: {offline_after_s: 2}", "MC739", "2"),
        ("meshes: {main: {lan_mtu: 1600}}", "MC506", "1600"),
        ("meshes: {main: {lan_mtu: 1400}}", "MC508", "1400"),
        ("{system: {log_host: 10.42.0.100}, udp_mesh: {port: 514}}", "MC737", "514"),
        ("robots: {base-station: {is_base: false}}", "MC618", "false"),
        ("hardware: {rocket: {radios: {radio0: {amplifier_gain_db: 9}}}}", "MC344", "28"),
        ("hardware: {rocket: {lan_ports: []}}", "MC528", "lan_ports: []"),
        ("hardware: {rocket: {radios: {radio0: {max_drive_dbm: 31}}}}", "MC344", "31"),
    ],
)
def test_a_finding_about_two_values_points_at_the_explicit_one(
    fragment: str, code: str, text: str, tmp_path: Path
) -> None:
    (finding,) = (item for item in _found(fragment, tmp_path) if item.code == code)
    assert _at(finding, tmp_path).strip("'\"") == text


def test_a_profile_without_ports_is_one_finding_for_all_its_robots(tmp_path: Path) -> None:
    (finding,) = (item for item in _found("hardware: {rocket: {lan_ports: []}}", tmp_path) if item.code == "MC528")
    assert finding.path == "hardware.rocket.lan_ports"
    assert finding.message == "the computer of base-station, husky1 is cut off"


def test_a_duplicate_host_key_is_reported_at_the_key(tmp_path: Path) -> None:
    key = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f"
    own = key[:-4] + "HR4g"
    fragment = f"nodes: {{base: {{host_keys: ['{key}']}}, b01: {{host_keys: ['{own}', '{key}']}}}}"
    (finding,) = (item for item in _found(fragment, tmp_path) if item.code == "MC115")
    assert finding.path == "nodes.b01.host_keys.1"


_AT_5G = "meshes: {main: {band: 5g, channel: 149}}\ndefaults: {radios: {radio0: {mesh: null}, radio1: {mesh: main}}}\n"
_PACKAGES = "hardware: {rocket: {packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, DRIVER]}}\n"


@pytest.mark.parametrize(
    ("driver", "more", "codes"),
    [
        ("kmod-ath10k", "", ["MC841"]),
        ("kmod-ath10k-smallbuffers", "", ["MC841"]),
        ("kmod-ath10k-ct", "", []),
        ("kmod-ath9k", "", []),
        # what is written at a radio is known better than what is in the image
        ("kmod-ath10k", "radios: {radio1: {driver: ath9k}}", []),
    ],
)
def test_the_driver_of_a_5_ghz_radio_is_inferred_from_the_packages(
    driver: str, more: str, codes: list[str], tmp_path: Path
) -> None:
    hardware = _PACKAGES.replace("DRIVER", driver).rstrip("}\n") + (f", {more}" if more else "") + "}}\n"
    found = _found(_AT_5G + hardware, tmp_path)
    assert [item.code for item in found] == codes
    assert all(_at(item, tmp_path).startswith(driver) for item in found)


def test_a_5_ghz_driver_package_does_not_affect_the_2_4_ghz_radio(tmp_path: Path) -> None:
    assert _codes(_PACKAGES.replace("DRIVER", "kmod-ath10k"), tmp_path) == []


def test_802_11s_requires_driver_support(tmp_path: Path) -> None:
    fragment = (
        "{meshes: {main: {mode: mesh, encryption: sae}}, hardware: {rocket: {radios: {radio0: {driver: DRIVER}}}}}"
    )
    assert _codes(fragment.replace("DRIVER", "ath11k"), tmp_path) == []
    (tmp_path / "other").mkdir()
    assert _codes(fragment.replace("DRIVER", "brcmfmac"), tmp_path / "other") == ["MC841"]


@pytest.mark.parametrize("name", ["id.pub", "id"])
def test_a_public_key_in_place_of_a_private_one_is_found_by_its_content(name: str, tmp_path: Path) -> None:
    public = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f ada\n"
    example = Example(f"nodes: {{base: {{ssh: {{key_files: [{name}]}}}}}}", files={name: public})
    assert _codes(example, tmp_path) == ["MC433"]


def test_the_one_topic_at_a_wrong_level_is_reported_and_not_those_around_it(tmp_path: Path) -> None:
    others = "telemetry: {priority: 4}, maps: {class: map, priority: 6}, cameras: {class: video, priority: 8}"
    found = _found(f"topics: {{artifacts: {{priority: 12}}, {others}}}", tmp_path)
    (finding,) = [item for item in found if item.code == "MC704"]
    assert (finding.path, finding.message, finding.expected) == (
        "topics.artifacts.priority", "artifact follows telemetry (telemetry)", "less than 4"
    )  # fmt: skip


def test_the_range_of_host_addresses_has_none_that_is_refused(tmp_path: Path) -> None:
    (finding,) = [item for item in _found("nodes: {b01: {address: 10.42.0.255}}", tmp_path) if item.code == "MC203"]
    assert finding.expected == "one of 10.42.0.1 to 10.42.0.254"


def test_package_files_of_operator_parts_are_offered_to_the_nodes_of_the_mesh(tmp_path: Path) -> None:
    """They were part of images only: `plan` refused a node that lacked a package whose file was there."""
    text = _SECOND_CELL.replace("packages: [mm]", "packages: [mm], package_files: [mm_1_all.ipk]")
    files = {"parts/etc/config/mm.j2": "config mm\n", "mm_1_all.ipk": "package"}
    example = Example(text, files=files)
    fleet = load_fleet(write(example, tmp_path))
    renderer = Renderer.of(fleet, SecretStore(environment(example), tmp_path).get)
    assert renderer.desired(fleet.nodes["base"]).package_files == ("mm_1_all.ipk",)
