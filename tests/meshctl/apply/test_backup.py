"""A backup reads back unchanged, names what it was taken from, and nothing else is accepted as one."""

from __future__ import annotations

import contextlib
import gzip
import io
import tarfile
from base64 import b64decode
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.apply.backup import (
    Backup,
    departure,
    incompatibility,
    left_out,
    lockout_by,
    read_backup,
    unconfirmed,
    uninstalled_packages,
    with_info,
    without_wireless,
)
from meshctl.device.connection import OwnKey
from meshctl.device.deadman import NewFile
from meshctl.device.observation import BoardInfo, ChangeStatus, Observation
from meshctl.errors import InputError
from tests.meshctl.plan.support import fleet, running

INFO = {"node": "b01", "board": "compex,wpj344-16m", "revision": "r1", "taken_s": 12.5, "packages": ["iw", "wpad"]}


def archive(*members: tuple[str, bytes]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as tar:
        for name, content in members:
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o600
            tar.addfile(entry, io.BytesIO(content))
    return out.getvalue()


def saved(*members: tuple[str, bytes]) -> Backup:
    return read_backup(with_info(archive(("etc/config/network", b"config x\n"), *members), INFO), "b.tgz")


def test_a_backup_round_trips_with_its_metadata() -> None:
    backup = saved(("etc/dropbear/authorized_keys", b"key"))
    assert (backup.node, backup.board, backup.taken_s, backup.packages) == ("b01", INFO["board"], 12.5, ("iw", "wpad"))
    assert {path: new.content for path, new in backup.files.items()} == {
        "/etc/config/network": b"config x\n",
        "/etc/dropbear/authorized_keys": b"key",
    }
    assert backup.files["/etc/config/network"].mode == 0o600


@pytest.mark.parametrize("path", ["../../etc/passwd", "etc/../../x", "tmp/x/y", "etc/meshctl/change/armed", "a b/c"])
def test_unsafe_paths_are_excluded_from_a_backup(path: str) -> None:
    assert set(saved((path, b"x")).files) == {"/etc/config/network"}


def test_scripts_that_disable_services_at_boot_are_reported_and_not_restored() -> None:
    script = b"/etc/init.d/odhcpd disable\n/etc/init.d/meshctl-deadman disable\n\nexit 0\n"
    backup = saved(("./etc/uci-defaults/10_disable_services", script))
    assert set(backup.files) == {"/etc/config/network"}
    assert backup.disabled == ("odhcpd", "meshctl-deadman")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected a tar.gz archive"),
        (b"not gzip at all", "expected a tar.gz archive"),
        (gzip.compress(b"no tar"), "expected a tar.gz archive"),
        (archive(("etc/config/network", b"x")), "contains no meshctl-backup.json"),
        (with_info(archive(("etc/passwd", b"x")), INFO), "contains no configuration"),
        (archive(("meshctl-backup.json", b"["), ("etc/config/x", b"")), "meshctl-backup.json is damaged"),
        (archive(("meshctl-backup.json", b"[]"), ("etc/config/x", b"")), "expected an object"),
    ],
    # the archives hold the time they were made at, which must not be part of a test's name
    ids=["empty", "no gzip", "no tar", "no description", "nothing of ours", "broken description", "no object"],
)
def test_an_invalid_backup_is_rejected_with_its_file_name(data: bytes, message: str) -> None:
    with pytest.raises(InputError, match=r"^b\.tgz: ") as caught:
        read_backup(data, "b.tgz")
    assert message in str(caught.value)


@given(st.binary(max_size=200), st.integers(0, 400))
def test_corrupted_bytes_raise_only_input_errors(noise: bytes, at: int) -> None:
    data = bytearray(with_info(archive(("etc/config/network", b"config x\n")), INFO))
    data[at : at + len(noise)] = noise
    with contextlib.suppress(InputError):
        read_backup(bytes(data), "b.tgz")


def test_a_backup_of_a_node_that_is_being_changed_is_refused() -> None:
    idle, armed = ChangeStatus("idle", last_id="c1"), ChangeStatus("armed", owner="anna@base:7", last_id="c1")
    applied = replace(armed, state="applied")
    for before, after in ((idle, idle), (armed, armed), (None, ChangeStatus("absent", installed=False))):
        assert unconfirmed("b01", before, after) == ""
    for before, after in ((applied, applied), (idle, applied), (applied, idle)):
        assert unconfirmed("b01", before, after).startswith("b01: anna@base:7 changes it while it is backed up")
    # begun and rolled back in between, or the switch is new
    ended = ChangeStatus("idle", last_id="c2", last_outcome="restored")
    assert unconfirmed("b01", idle, ended).startswith("b01: it was changed while")
    assert unconfirmed("b01", None, ended)


def test_a_backup_is_restored_only_to_its_own_node_and_board() -> None:
    seen = running(fleet(), "b01")
    assert incompatibility(saved(), "b01", seen) == ""
    assert "the backup is of node b01, not b02" in incompatibility(saved(), "b02", seen)
    assert "is ubnt,rocket-m" in incompatibility(saved(), "b01", replace(seen, board=BoardInfo("ubnt,rocket-m")))
    assert uninstalled_packages(saved(), replace(seen, packages={"iw": "1"})) == ("wpad",)


def test_a_backup_whose_authorized_keys_lock_us_out_is_rejected() -> None:
    node = fleet().nodes["b01"]
    keys = {"/etc/dropbear/authorized_keys": NewFile(f"{fleet().operators.ssh_keys[0]}\n".encode(), 0o600)}
    ours = OwnKey("agent key", "ssh-ed25519", b64decode(fleet().operators.ssh_keys[0].split()[1]))
    assert lockout_by(saved(), node, ()) is None
    assert lockout_by(replace(saved(), files=keys), node, (ours,)) is None
    refused = lockout_by(replace(saved(), files=keys), node, ())
    assert refused is not None
    assert f"it gets the keys {ours.fingerprint} (alice)" in refused.reason


def _backup_of(seen: Observation) -> Backup:
    return saved(*((f"etc/config/{package}", text.encode()) for package, text in (seen.uci or {}).items()))


def test_a_backup_from_before_a_change_of_the_cell_is_restored_without_its_radios_only() -> None:
    backup, seen = _backup_of(running(fleet(channel=6), "b01")), running(fleet(channel=11), "b01")
    refused = departure(backup, "b01", seen)
    assert refused == (
        "the backup has another cell (radio0: channel 11 -> 6): b01 would leave the mesh neighbor it hears"
    )
    assert departure(without_wireless(backup), "b01", seen) == ""
    assert "/etc/config/network" in without_wireless(backup).files
    # in the backup's cell, or out of reach of any other node
    assert departure(backup, "b01", running(fleet(channel=6), "b01")) == ""
    assert departure(backup, "b01", replace(seen, neighbors=())) == ""


def test_a_backup_from_before_a_change_of_the_key_is_not_restored() -> None:
    backup = _backup_of(running(fleet(), "b01"))
    wireless = backup.files["/etc/config/wireless"]
    other = NewFile(wireless.content.replace(b"correct horse", b"another horse"), wireless.mode)
    refused = departure(
        replace(backup, files={**backup.files, "/etc/config/wireless": other}), "b01", running(fleet(), "b01")
    )
    assert "(radio0: key changes)" in refused
    assert "horse" not in refused


def test_an_archive_without_a_file_that_the_node_has_is_no_backup() -> None:
    """Seen with an image whose keep.d lacks /etc/config: a restore was done, and had restored nothing."""
    seen = running(fleet(), "b01")
    whole = _backup_of(seen)
    assert left_out(whole, seen) == ()
    files = {path: file for path, file in whole.files.items() if path != "/etc/config/wireless"}
    assert left_out(replace(whole, files=files), seen) == ("/etc/config/wireless",)
    assert left_out(replace(whole, files=files), replace(seen, uci=None)) == ()
