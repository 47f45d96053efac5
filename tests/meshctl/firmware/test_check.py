"""An image against its profile: each thing that can be wrong is distinguished."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from meshctl.firmware import BadSignature, append_metadata, check, image_path, parse_public_key, sha256, verify
from meshctl.model import Firmware, HardwareProfile, Release
from tests.meshctl.render import fleets

VECTORS = Path(__file__).parent / "vectors"
SHA256 = "e48ed45c7ac2efa17f8c76fd8df4747a981ca9fa6b6410302bc761928a4e2be6"


def profile(base: Path = VECTORS, release: Release = Release.V23_05, **changes: Any) -> HardwareProfile:
    usual = Firmware("image.bin", SHA256, "r24106", "key.pub", str(base))
    return fleets.hardware(release, firmware=replace(usual, **changes))


def codes(image: Path, wanted: HardwareProfile) -> list[str]:
    return [item.code for item in check(image, wanted)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("image.bin", "key.pub", "sha256sums", "sha256sums.sig"):
        shutil.copy(VECTORS / name, tmp_path / name)
    return tmp_path


def test_a_valid_image_passes(folder: Path) -> None:
    assert check(folder / "image.bin", profile(folder)) == ()
    assert image_path(profile(folder)) == folder / "image.bin"


def test_a_detached_signature_of_the_image_is_accepted(folder: Path) -> None:
    (folder / "sha256sums").unlink()
    shutil.copy(VECTORS / "image.bin.sig", folder)
    assert check(folder / "image.bin", profile(folder)) == ()


def test_a_profile_without_an_image_names_no_path() -> None:
    assert image_path(fleets.hardware(Release.V23_05)) is None


def test_a_missing_image_is_unreadable(folder: Path) -> None:
    (finding,) = check(folder / "none.bin", profile(folder))
    assert finding.code == "FW001"
    assert "No such file" in finding.message


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"sha256": "0" * 64}, "FW002"),
        ({"revision": "r2410"}, "FW007"),
        ({"revision": "r24106-other"}, "FW007"),
        ({"usign_key": "none.pub"}, "FW008"),
        ({"usign_key": "image.bin"}, "FW008"),
    ],
)
def test_a_wrong_hash_revision_or_signing_key_is_detected(folder: Path, changes: dict[str, Any], code: str) -> None:
    assert codes(folder / "image.bin", profile(folder, **changes)) == [code]


def test_a_wrong_board_target_or_release_is_detected(folder: Path) -> None:
    image = folder / "image.bin"
    assert codes(image, replace(profile(folder), board="ubnt,rocket-m")) == ["FW005"]
    assert codes(image, replace(profile(folder), target="ath79/mikrotik")) == ["FW005"]
    assert codes(image, replace(profile(folder), release=Release.V24_10)) == ["FW006"]


def test_missing_and_damaged_metadata_are_distinguished(folder: Path) -> None:
    image = folder / "image.bin"
    whole = image.read_bytes()
    plain = profile(folder, sha256="", usign_key="")
    image.write_bytes(whole[:96])
    assert codes(image, plain) == ["FW004"]
    image.write_bytes(b"X" + whole[1:])
    assert codes(image, plain) == ["FW003"]


def test_a_snapshot_image_skips_the_release_check(folder: Path) -> None:
    version = {"version": "SNAPSHOT", "revision": "r24106-1", "target": "ath79/generic"}
    image = folder / "image.bin"
    image.write_bytes(append_metadata(b"x", {"supported_devices": ["compex,wpj344-16m"], "version": version}))
    assert codes(image, profile(folder, sha256="", usign_key="")) == []


def test_a_modified_checksum_list_fails_signature_verification(folder: Path) -> None:
    sums = folder / "sha256sums"
    sums.write_text(sums.read_text() + f"{'0' * 64} *other.bin\n")
    (finding,) = check(folder / "image.bin", profile(folder))
    assert finding.code == "FW008"
    assert "does not match" in finding.message


def test_an_image_not_in_the_signed_checksum_list_is_unsigned(folder: Path) -> None:
    (folder / "image.bin").rename(folder / "other.bin")
    assert codes(folder / "other.bin", profile(folder)) == ["FW008"]


def test_a_replaced_image_fails_the_signed_checksum_list(folder: Path) -> None:
    image = folder / "image.bin"
    metadata = {"supported_devices": ["compex,wpj344-16m"]}
    image.write_bytes(append_metadata(b"evil", metadata))
    (finding,) = check(image, profile(folder, sha256=""))
    assert finding.code == "FW008"
    assert finding.found == sha256(image.read_bytes())


def test_a_missing_signature_hints_at_the_required_files(folder: Path) -> None:
    (folder / "sha256sums").unlink()
    (finding,) = check(folder / "image.bin", profile(folder))
    assert finding.hint == "put image.bin.sig, or sha256sums and sha256sums.sig, beside the image"


def test_a_usign_signature_verifies_only_its_own_message_and_key() -> None:
    key = parse_public_key((VECTORS / "key.pub").read_text())
    signature = (VECTORS / "sha256sums.sig").read_text()
    message = (VECTORS / "sha256sums").read_bytes()
    verify(message, signature, key)
    with pytest.raises(BadSignature, match="does not match"):
        verify(message + b"x", signature, key)
    with pytest.raises(BadSignature, match="by key"):
        verify(message, signature, replace(key, name=bytes(8)))


@pytest.mark.parametrize(
    "text", ["", "untrusted comment: x\n", "x\nRWQ=\n", "untrusted comment: x\nRWQ=\n", "untrusted comment: x\n!\n"]
)
def test_an_invalid_public_key_is_rejected(text: str) -> None:
    with pytest.raises(BadSignature, match="expected"):
        parse_public_key(text)
