"""The pure parts: wheel tags, probe output, bundles and IDs, switch results, key rotation."""

from __future__ import annotations

import platform
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from io import BytesIO
from ipaddress import IPv4Address, IPv4Interface
from pathlib import Path

import pytest

from meshctl.errors import InputError
from meshctl.fleet import Result
from meshctl.inventory import load_fleet
from meshctl.model import Computer, Reduction, Robot, SecretKind, SecretRef, Topic
from meshctl.robots.bundle import UNIT_NAME, Bundle, File, configuration, service_unit
from meshctl.robots.connection import selected_robots
from meshctl.robots.deploy import parse_switch
from meshctl.robots.key_rotation import inventory_value, parse_ref, rotation_stages
from meshctl.robots.preconditions import (
    HostFacts,
    changed_files,
    clock_warning,
    parse_facts,
    route_warning,
    routed_peers,
    unmet_disk_space,
    unmet_preconditions,
)
from meshctl.robots.wheel_tags import Target, is_compatible, parse_wheel, pip_options
from meshctl.robots.wheels import REQUIREMENTS, has_all, own_wheel, requirements, select_wheels, stock_units
from tests.meshctl.render import fleets

ROOT = Path(__file__).resolve().parents[3]

BOOKWORM = Target((3, 11), "x86_64", "glibc", (2, 36))
PI = Target((3, 12), "aarch64", "glibc", (2, 39))
ALPINE = Target((3, 12), "x86_64", "musl", (1, 2))


@pytest.mark.parametrize(
    ("file", "takers"),
    [
        ("pycparser-2.22-py3-none-any.whl", {BOOKWORM, PI, ALPINE}),
        ("cffi-1.17.1-cp311-cp311-manylinux_2_17_x86_64.manylinux2014_x86_64.whl", {BOOKWORM}),
        ("cffi-1.17.1-cp312-cp312-manylinux_2_17_aarch64.manylinux2014_aarch64.whl", {PI}),
        ("cryptography-44.0.0-cp37-abi3-manylinux_2_28_x86_64.whl", {BOOKWORM}),
        ("cryptography-44.0.0-cp37-abi3-manylinux_2_38_x86_64.whl", set()),
        ("cryptography-44.0.0-cp37-abi3-musllinux_1_2_x86_64.whl", {ALPINE}),
        ("cryptography-44.0.0-cp313-abi3-manylinux_2_28_aarch64.whl", set()),
        ("cryptography-44.0.0-pp310-pypy310_pp73-manylinux_2_28_x86_64.whl", set()),
    ],
)
def test_wheel_compatibility_matches_pip(file: str, takers: set[Target]) -> None:
    wheel = parse_wheel(file)
    assert wheel is not None
    assert {target for target in (BOOKWORM, PI, ALPINE) if is_compatible(target, wheel)} == takers


def test_pip_options_match_the_target_python_and_platforms() -> None:
    options = pip_options(PI)
    assert options[:2] == ("--python-version", "3.12")
    assert "manylinux_2_39_aarch64" in options
    assert "manylinux2014_aarch64" in options
    assert "manylinux_2_40_aarch64" not in options


def test_own_wheel_contains_only_udp_mesh_and_the_unit_starts_the_current_release() -> None:
    with zipfile.ZipFile(BytesIO(own_wheel().content)) as archive:
        tops = {name.split("/")[0] for name in archive.namelist()}
    assert {top.split("-")[0] for top in tops} == {"udp_mesh"}
    unit = service_unit(stock_units()[UNIT_NAME], "/opt/udp-mesh/current/bin/udp-mesh run FILE")
    starts = [line for line in unit.splitlines() if line.startswith("ExecStart=")]
    assert starts == ["ExecStart=/opt/udp-mesh/current/bin/udp-mesh run FILE"]
    with pytest.raises(ValueError, match="one ExecStart"):
        service_unit("[Service]\n", "x")


@pytest.mark.parametrize(
    ("target", "has_zstd"),
    [
        (BOOKWORM, True),
        (PI, True),
        (ALPINE, True),
        # part of Python
        (Target((3, 14), "x86_64", "glibc", (2, 41)), False),
        # without a wheel of it, the robot gets plain messages
        (Target((3, 11), "armv7l", "glibc", (2, 36)), False),
    ],
)
def test_a_bundle_has_zstd_where_python_does_not(target: Target, has_zstd: bool, tmp_path: Path) -> None:
    assert requirements(target) == (*REQUIREMENTS, *(["backports-zstd"] if has_zstd else []))
    python, libc = "".join(map(str, target.python)), "manylinux" if target.libc == "glibc" else "musllinux"
    tag = f"{libc}_{target.libc_version[0]}_{target.libc_version[1]}_{target.arch}"
    for project in REQUIREMENTS:
        zipfile.ZipFile(tmp_path / f"{project}-9.0-cp{python}-cp{python}-{tag}.whl", "w").close()
    assert has_all(target, tmp_path) is not has_zstd
    if has_zstd:
        with pytest.raises(InputError, match=f"expected a wheel of backports-zstd for {target}, found none"):
            select_wheels(target, tmp_path)
        zipfile.ZipFile(tmp_path / f"backports_zstd-1.0-cp{python}-cp{python}-{tag}.whl", "w").close()
    picked = [wheel.file.partition("-")[0] for wheel in select_wheels(target, tmp_path)]
    assert picked == ["udp_mesh", *REQUIREMENTS, *(["backports_zstd"] if has_zstd else [])]


def test_the_wheels_of_a_bundle_give_a_robot_differences_and_it_runs_without_them(wheels: Path, tmp_path: Path) -> None:
    """In an interpreter that finds nothing but the unpacked wheels, as on a robot."""
    libc, version = platform.libc_ver()
    major, minor = version.split(".")[:2]
    target = Target(sys.version_info[:2], platform.machine(), libc, (int(major), int(minor)))
    for wheel in select_wheels(target, wheels):
        with zipfile.ZipFile(BytesIO(wheel.content)) as archive:
            archive.extractall(tmp_path)
    code = """
import sys
sys.path.append(sys.argv[1])
import udp_mesh.cli.main, udp_mesh.daemon.service
from udp_mesh.core.peers.heartbeat import own_features
from udp_mesh.core.settings import Settings
from udp_mesh.wire.frames import Feature
print(own_features(Settings("a", unkeyed=True)) & (Feature.ZSTD | Feature.VERSIONS))
"""

    def features() -> int:
        words = [sys.executable, "-I", "-S", "-c", code, str(tmp_path)]
        return int(subprocess.run(words, capture_output=True, check=True, timeout=60).stdout)

    assert features() == 64 | 128
    if sys.version_info < (3, 14):
        shutil.rmtree(tmp_path / "backports")
        assert features() == 0


def test_a_bundle_id_depends_on_its_content_and_its_repr_hides_secrets() -> None:
    key = File("etc/fleet.key", b"0123456789", 0o600)
    one, same = (Bundle("husky1", "tree", (), (key, File("topics", b"estop\n"))) for _ in range(2))
    other = Bundle("husky1", "tree", (), (File("etc/fleet.key", b"9876543210", 0o600), File("topics", b"estop\n")))
    assert one.id == same.id != other.id
    assert one.archive() == same.archive()
    assert "0123456789" not in repr(one)


PROBED = """\
arch=x86_64
now=1000000000
uid=0
systemd=yes
missing=
python=3.11.2
implementation=CPython
bits=64
libc=glibc 2.36
executable=/usr/bin/python3.11
free_kib=500000
writable=yes
current=aaaa
previous=
release=aaaa
tree=tttt
proven=yes
file=1111  etc/udp-mesh.toml
file=2222  python
file=3333  udp-mesh.service
unit=udp-mesh.service active enabled
unit=udp-mesh-ros1.service inactive
"""


def _reasons(facts: HostFacts) -> list[str]:
    return [reason for reason, _ in unmet_preconditions(facts, robot="r", arch="x86_64", python="python3")]


def test_all_unmet_preconditions_are_reported_at_once() -> None:
    facts = parse_facts(PROBED)
    assert facts.is_sound
    assert facts.target == BOOKWORM
    assert _reasons(facts) == []
    worse = parse_facts(
        PROBED.replace("arch=x86_64", "arch=aarch64").replace("3.11.2", "3.8.10").replace("systemd=yes", "systemd=no")
    )
    assert _reasons(worse) == [
        "systemd is not running",
        "wrong CPU: expected x86_64, found aarch64",
        "wrong Python: python3 is 3.8.10, expected 3.11 or newer",
    ]
    assert _reasons(parse_facts(f"{PROBED}noexec=yes\nunit=udp-mesh-ros1.service inactive masked\n")) == [
        "/opt is mounted noexec",
        "masked units: udp-mesh-ros1.service",
    ]
    assert _reasons(parse_facts("")) != [], "a probe that says nothing is no consent"


def test_a_clock_far_off_is_reported_but_does_not_block() -> None:
    facts = parse_facts(PROBED)
    assert clock_warning(facts, 1e9) == ("", "")
    assert clock_warning(facts, 1.2e9)[0] == "its clock is 6 years behind ours"
    assert clock_warning(facts, 1e9 - 7 * 86_400)[0] == "its clock is 7 d ahead of ours"
    assert _reasons(facts) == []


def test_a_missing_route_to_a_peer_is_reported_with_its_gateway() -> None:
    fleet = load_fleet(ROOT / "inventory/routed")
    assert routed_peers(fleet, "rover1") == {
        "10.43.0.10": "base-station",
        "10.43.2.10": "rover2",
        "10.42.0.23": "rover3",
    }
    facts = parse_facts(f"{PROBED}no_route=10.43.2.10\nno_route=10.42.0.23\n")
    reason, hint = route_warning(facts, fleet, "rover1")
    assert reason == "it has no route to rover2 (10.43.2.10), rover3 (10.42.0.23)"
    assert "through 10.43.1.1" in hint
    assert route_warning(parse_facts(PROBED), fleet, "rover1") == ("", "")
    # separate meshes without routers between them need no routes
    assert routed_peers(load_fleet(ROOT / "inventory/subt-final"), "husky1") == {}


def test_required_disk_space_includes_a_reserve() -> None:
    facts = parse_facts(PROBED)
    assert not list(unmet_disk_space(facts, 100 << 20))
    ((reason, _),) = unmet_disk_space(facts, 1 << 30)
    assert reason.startswith("disk full: expected 1057 MiB in /opt")


def test_files_with_a_different_hash_or_missing_on_one_side_are_changed() -> None:
    facts = parse_facts(PROBED)
    assert changed_files(facts, [("etc/udp-mesh.toml", "1111"), ("python", "2222"), ("udp-mesh.service", "3333")]) == ()
    wanted = [("etc/udp-mesh.toml", "3333"), ("udp-mesh.service", "3333"), ("new", "1")]
    assert changed_files(facts, wanted) == ("etc/udp-mesh.toml", "new", "python")


def test_switch_output_is_parsed_into_an_outcome() -> None:
    assert parse_switch("r", "id", "result=switched\nonline=base husky2\n").reason == "runs id, 2 peers online"
    back = parse_switch("r", "id", "result=rolled-back\nreason=the daemon does not run\nlog=a=b\nlog=c\n")
    assert back.result is Result.ROLLED_BACK
    assert back.hint == "last log lines:\na=b\nc"
    absent = "result=rolled-back-ill\nreason=peers were online before and are not seen: husky2\nlog=a\nstill="
    gone = parse_switch("r", "id", f"{absent}peers were online before and are not seen: husky2\n")
    assert gone.hint == "the new release may not be the cause: run the command again\nlast log lines:\na"
    assert parse_switch("r", "id", f"{absent}the daemon does not run\n").hint == "last log lines:\na"
    assert parse_switch("r", "id", "").result is Result.FAILED


OLD, NEW, OTHER = (SecretRef(SecretKind.ENV, name) for name in ("OLD", "NEW", "OTHER"))


def test_key_rotation_continues_from_the_stage_in_the_inventory() -> None:
    every = [(OLD, NEW), (NEW, OLD), (NEW,)]
    assert [stage.keys for stage in rotation_stages((OLD,), NEW)] == every
    assert [stage.keys for stage in rotation_stages((OLD, NEW), NEW)] == every
    assert [stage.keys for stage in rotation_stages((NEW, OLD), NEW)] == every[1:]
    assert [stage.keys for stage in rotation_stages((NEW,), NEW)] == every[2:]
    with pytest.raises(InputError, match="two other keys"):
        rotation_stages((OLD, OTHER), NEW)
    with pytest.raises(InputError, match="the fleet has no key"):
        rotation_stages((), NEW)


@pytest.mark.parametrize("text", ["env:NAME", "file:a/b.yaml#new", "age:keys.age#x"])
def test_a_secret_reference_round_trips(text: str) -> None:
    assert str(parse_ref(text)) == text
    assert parse_ref(text).kind.value in dict(inventory_value(parse_ref(text)))  # type: ignore[arg-type]


@pytest.mark.parametrize("text", ["NAME", "env:", "vault:x", ""])
def test_an_invalid_secret_reference_is_rejected(text: str) -> None:
    with pytest.raises(InputError, match="expected env:NAME"):
        parse_ref(text)


def test_a_robot_without_a_computer_is_skipped_or_rejected_with_a_hint() -> None:
    moved = Robot("husky1", (), Computer(IPv4Interface("10.42.0.10/24")))
    fleet = fleets.fleet(
        robots={
            "husky1": moved,
            "husky2": Robot("husky2", (), fielded=IPv4Address("10.42.0.20")),
            "cart": Robot("cart", ()),
        }
    )
    assert selected_robots(fleet, None, str) == ("husky1",)
    with pytest.raises(InputError) as caught:
        selected_robots(fleet, ["husky2"], str)
    assert caught.value.hint == "set robots.husky2.computer in place of `fielded`, and stop the legacy program there"
    with pytest.raises(InputError) as caught:
        selected_robots(fleet, ["cart"], str)
    assert caught.value.hint == "set robots.cart.computer"


def test_a_release_with_a_bridge_has_what_it_reduces() -> None:
    camera = Topic("camera", 9, reduce=Reduction(rate_hz=1.0))
    computer = Computer(IPv4Interface("10.42.0.10/24"), ros="noetic")
    robots = {"husky1": Robot("husky1", (), computer), "spot": Robot("spot", (), replace(computer, ros="humble"))}
    fleet = fleets.fleet(robots=robots, topics=(camera,))
    paths = {name: {file.path for file in configuration(fleet, name, fleets.secrets, stock_units())} for name in robots}
    assert "etc/bridge.yaml" in paths["husky1"]
    assert "etc/bridge.yaml" not in paths["spot"]
    plain = replace(fleet, topics=(replace(camera, reduce=None),))
    unchanged = {file.path for file in configuration(plain, "husky1", fleets.secrets, stock_units())}
    assert unchanged == paths["husky1"] - {"etc/bridge.yaml"}
