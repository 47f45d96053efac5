"""The archive that a flashed node unpacks at its first boot."""

from __future__ import annotations

import io
import tarfile

from meshctl.apply.sysupgrade import MARKER_PATH, archive
from meshctl.device import deadman
from meshctl.device.openwrt import FetchedFile
from tests.meshctl.plan.support import fleet, wanted

KEYS = {"/etc/dropbear/dropbear_ed25519_host_key": FetchedFile(b"private", 0o600)}


def members(data: bytes) -> dict[str, tarfile.TarInfo]:
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:gz") as tar:
        return {member.name: member for member in tar}


def test_the_archive_holds_configuration_host_keys_dead_mans_switch_and_marker() -> None:
    found = members(archive(wanted(fleet(), "b01"), KEYS, "mark"))
    rendered = {file.path for file in wanted(fleet(), "b01").files}
    switch = {path.lstrip("/") for path in deadman.installed_files()}
    assert set(found) == {
        *rendered,
        *switch,
        "etc/dropbear/dropbear_ed25519_host_key",
        MARKER_PATH.lstrip("/"),
        deadman.INIT_LINK.lstrip("/"),
    }


def test_private_files_stay_private_and_the_boot_hook_is_enabled() -> None:
    found = members(archive(wanted(fleet(), "b01"), KEYS, "mark"))
    assert found["etc/dropbear/dropbear_ed25519_host_key"].mode == 0o600
    assert found["etc/config/wireless"].mode == 0o600
    assert found[deadman.INIT_LINK.lstrip("/")].issym()
    assert {member.uid for member in found.values()} == {0}


def test_the_archive_is_deterministic() -> None:
    assert archive(wanted(fleet(), "b01"), KEYS, "mark") == archive(wanted(fleet(), "b01"), KEYS, "mark")
