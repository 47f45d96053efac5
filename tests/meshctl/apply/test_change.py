"""Laws of a change: it holds what differs, knows what was there, and reloads what changed."""

from __future__ import annotations

import hashlib
import os
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.apply.change import SPEAK_FRAMES, change_of, new_change_id, new_nonce, reload_script
from meshctl.device.deadman import bundle
from tests.meshctl.plan.support import PASS_PHRASE, factory, fleet, planned, running, wanted


def test_a_change_holds_exactly_the_files_that_differ_and_what_was_there() -> None:
    team, seen = fleet(channel=11), running(fleet(), "b01")
    change = change_of("c1", planned(team, "b01", seen), wanted(team, "b01"), seen, ())
    assert set(change.files) == {"/etc/config/wireless", "/etc/meshctl/node"}
    assert seen.uci is not None
    assert change.expected["/etc/config/wireless"] == hashlib.sha256(seen.uci["wireless"].encode()).hexdigest()
    assert change.reload == "status=0\nreload_config || status=$?\nexit $status\n"


def test_what_is_not_there_yet_is_expected_to_be_absent() -> None:
    seen = factory(fleet(), "b01")
    change = change_of("c1", planned(fleet(), "b01", seen), wanted(fleet(), "b01"), seen, ())
    assert change.expected["/etc/dropbear/authorized_keys"] is None


def test_bytes_that_were_lost_on_the_way_are_not_expected() -> None:
    team, seen = fleet(channel=11), running(fleet(), "b01")
    assert seen.uci is not None
    odd = replace(seen, uci={**seen.uci, "wireless": seen.uci["wireless"] + "# \ufffd\n"})
    change = change_of("c1", planned(team, "b01", odd), wanted(team, "b01"), odd, ())
    assert "/etc/config/wireless" not in change.expected


def test_every_rendered_path_is_one_that_the_switch_takes() -> None:
    seen = factory(fleet(), "b01")
    assert bundle(change_of("c1", planned(fleet(), "b01", seen), wanted(fleet(), "b01"), seen, ()))


def test_a_change_is_never_printed_with_its_secrets() -> None:
    seen = factory(fleet(), "b01")
    plan = planned(fleet(), "b01", seen)
    assert PASS_PHRASE not in repr(change_of("c1", plan, wanted(fleet(), "b01"), seen, ()))
    assert PASS_PHRASE not in repr(wanted(fleet(), "b01"))


def test_a_key_file_reloads_nothing_and_a_back_ends_service_is_restarted() -> None:
    assert reload_script({"etc/dropbear/authorized_keys"}, ()) == "status=0\nexit $status\n"
    assert "/etc/init.d/meshmerize restart || status=$?" in reload_script({"etc/config/network"}, ("meshmerize",))


@pytest.mark.parametrize(
    ("network", "known", "restarts"),
    [
        ("option proto 'batadv'", 'printf \'{"static": {}, "batadv": {}}\'', False),
        ("option proto 'batadv'", "printf '{\"static\": {}}'", True),
        ("option proto 'static'", "printf '{\"static\": {}}'", False),
        ("option proto 'batadv'", "false", False),
    ],
)
def test_netifd_starts_anew_where_it_does_not_know_batman_adv_yet(
    tmp_path: Path, network: str, known: str, restarts: bool
) -> None:
    (tmp_path / "network").write_text(network)
    script = reload_script({"etc/config/network"}, ())
    script = script.replace("/etc/config/network", str(tmp_path / "network"))
    script = script.replace("/etc/init.d/network restart", "echo restarts")
    stands_in = f"reload_config() {{ :; }}\nubus() {{ {known}; }}\n"
    done = subprocess.run(
        ["sh", "-c", stands_in + script], env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, "restarts" if restarts else "")


@pytest.mark.parametrize(
    ("client", "pings"),
    [({"SSH_CONNECTION": "10.42.0.2 51000 10.42.0.11 22"}, [f"-c {SPEAK_FRAMES} 10.42.0.2"]), ({}, [])],
)
def test_a_node_whose_network_changes_speaks_to_whom_it_was_spoken_to_by_and_waits_for_no_answer(
    tmp_path: Path, client: dict[str, str], pings: list[str]
) -> None:
    (tmp_path / "ping").write_text(f'#!/bin/sh\nread -r _ <"{tmp_path}/go"\necho "$@" >>"{tmp_path}/pings"\n')
    (tmp_path / "ping").chmod(0o755)
    os.mkfifo(tmp_path / "go")
    script = "reload_config() { :; }\n" + reload_script({"etc/config/network"}, ())
    environ = {"PATH": f"{tmp_path}:/usr/bin:/bin", **client}
    # it ends although the ping has not
    subprocess.run(["sh", "-c", script], env=environ, check=True, timeout=60)
    if pings:
        (tmp_path / "go").write_text("\n")
    log = tmp_path / "pings"
    deadline = time.monotonic() + 60
    while pings and not (log.exists() and log.read_text()):
        assert time.monotonic() < deadline, "it did not speak"
        time.sleep(0.01)
    assert (log.read_text().splitlines() if log.exists() else []) == pings
    assert "ping" not in reload_script({"etc/config/wireless"}, ())


def test_ids_and_nonces_never_repeat() -> None:
    assert len({new_change_id() for _ in range(100)}) == 100
    assert len({new_nonce().reveal() for _ in range(100)}) == 100
