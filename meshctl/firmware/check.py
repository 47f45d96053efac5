"""Check an image against its hardware profile, before it is sent to a node.

In order: it is readable; its SHA-256 matches; its trailers are intact; board, target, release and revision match; and,
if the profile names a key, its signature is valid. The device checks less: stock images accept any signature, and no
device checks the revision.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from meshctl.diagnostics import Diagnostic, Position, Severity
from meshctl.file_access import located, special_file
from meshctl.firmware.metadata import Metadata, read_metadata
from meshctl.firmware.trailer import DamagedImage
from meshctl.firmware.usign import BadSignature, PublicKey, parse_public_key, verify
from meshctl.model import HardwareProfile

# The codes are documented in docs/render.md.
UNREADABLE = "FW001"
WRONG_HASH = "FW002"
DAMAGED = "FW003"
NO_METADATA = "FW004"
WRONG_BOARD = "FW005"
WRONG_RELEASE = "FW006"
WRONG_REVISION = "FW007"
BAD_SIGNATURE = "FW008"

# The largest flash of any supported board; a larger file is not an image, and is not read into memory.
MAX_IMAGE_BYTES = 256 * 1024 * 1024
# Key, signature and hash list are short texts; the list of a hundred images has 20 kB.
_MAX_TEXT_BYTES = 1024 * 1024


def check(image: Path, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
    """The faults of `image` for `profile`. Positions name the files concerned."""
    try:
        content = _read(image, MAX_IMAGE_BYTES)
    except OSError as error:
        return (_error(UNREADABLE, image, f"cannot be read: {error.strerror or error}"),)
    return (
        *_check_hash(image, content, profile.firmware.sha256),
        *_check_metadata(image, content, profile),
        *_check_signature(image, content, profile),
    )


def image_path(profile: HardwareProfile) -> Path | None:
    """The path of the profile's image, None if it names none."""
    firmware = profile.firmware
    return located(firmware.base, firmware.image) if firmware.image else None


def image_version(image: Path) -> str:
    """The OpenWrt version in the image's metadata, such as `25.12.0-rc1`; empty if unknown."""
    try:
        metadata = read_metadata(_read(image, MAX_IMAGE_BYTES))
    except (OSError, ValueError, DamagedImage):
        return ""
    return "" if metadata is None else metadata.version


def sha256(content: bytes) -> str:
    """The hash as `sha256sum` prints it."""
    return hashlib.sha256(content).hexdigest()


def _read(path: Path, limit: int) -> bytes:
    if reason := special_file(path):
        raise OSError(reason)
    with path.open("rb") as stream:
        content = stream.read(limit + 1)
    if len(content) > limit:
        raise OSError(f"it is larger than {limit} bytes")
    return content


def _check_hash(image: Path, content: bytes, expected: str) -> tuple[Diagnostic, ...]:
    found = sha256(content)
    if not expected or found == expected.lower():
        return ()
    return (_error(WRONG_HASH, image, "not the image named in the inventory", expected=expected.lower(), found=found),)


def _check_metadata(image: Path, content: bytes, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
    try:
        metadata = read_metadata(content)
    except DamagedImage as error:
        return (_error(DAMAGED, image, str(error)),)
    if metadata is None:
        hint = "use the sysupgrade image, not the factory one"
        return (_error(NO_METADATA, image, "no metadata: sysupgrade would reject it", hint=hint),)
    return (*_check_board(image, metadata, profile), *_check_version(image, metadata, profile))


def _check_board(image: Path, metadata: Metadata, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
    found = []
    if profile.board not in metadata.boards:
        boards = ", ".join(metadata.boards) or "none"
        found.append(_error(WRONG_BOARD, image, "made for another board", expected=profile.board, found=boards))
    if metadata.target and profile.target and metadata.target != profile.target:
        message = "made for another target"
        found.append(_error(WRONG_BOARD, image, message, expected=profile.target, found=metadata.target))
    return tuple(found)


def _check_version(image: Path, metadata: Metadata, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
    """Snapshots have no release number and pass, as do images without a version or revision."""
    found = []
    release = str(profile.release)
    is_release = metadata.version[:1].isdigit()
    if is_release and metadata.version != release and not metadata.version.startswith((f"{release}.", f"{release}-")):
        message = "built for another release than the profile's"
        found.append(_error(WRONG_RELEASE, image, message, expected=release, found=metadata.version))
    wanted = profile.firmware.revision
    if wanted and metadata.revision and not is_revision(metadata.revision, wanted):
        message = "not the revision named in the inventory"
        found.append(_error(WRONG_REVISION, image, message, expected=wanted, found=metadata.revision))
    return tuple(found)


def is_revision(found: str, wanted: str) -> bool:
    """Whether a revision matches; `r24106` also matches `r24106-10cc5fcd00`."""
    return found == wanted or found.startswith(f"{wanted}-")


def _check_signature(image: Path, content: bytes, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
    """Verify `IMAGE.sig`, or `sha256sums` and `sha256sums.sig` beside the image, as OpenWrt publishes them."""
    if not profile.firmware.usign_key:
        return ()
    key_path = located(profile.firmware.base, profile.firmware.usign_key)
    try:
        key = parse_public_key(_text(key_path))
    except (BadSignature, OSError, UnicodeDecodeError) as error:
        return (_error(BAD_SIGNATURE, key_path, f"no key to verify {image.name}: {_reason(error)}"),)
    own = image.with_name(f"{image.name}.sig")
    sums = image.with_name("sha256sums")
    try:
        if own.exists():
            verify(content, _text(own), key)
            return ()
        return _check_sums(image, content, sums, key)
    except (BadSignature, OSError, UnicodeDecodeError) as error:
        place = own if own.exists() else sums.with_name("sha256sums.sig")
        hint = (
            f"put {own.name}, or sha256sums and sha256sums.sig, beside the image" if isinstance(error, OSError) else ""
        )
        return (_error(BAD_SIGNATURE, place, f"{image.name} has no valid signature: {_reason(error)}", hint=hint),)


def _check_sums(image: Path, content: bytes, sums: Path, key: PublicKey) -> tuple[Diagnostic, ...]:
    signed = _read(sums, _MAX_TEXT_BYTES)
    verify(signed, _text(sums.with_name("sha256sums.sig")), key)
    listed = {name.lstrip(" *"): digest for digest, _, name in _entries(signed.decode())}
    expected = listed.get(image.name)
    if expected is None:
        return (_error(BAD_SIGNATURE, sums, f"{image.name} is not in the signed list"),)
    found = sha256(content)
    if found == expected.lower():
        return ()
    message = f"{image.name} is not the signed file"
    return (_error(BAD_SIGNATURE, sums, message, expected=expected.lower(), found=found),)


def _entries(text: str) -> list[tuple[str, str, str]]:
    return [line.partition(" ") for line in text.splitlines() if line.strip()]


def _text(path: Path) -> str:
    return _read(path, _MAX_TEXT_BYTES).decode("utf-8")


def _reason(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"{error.filename or 'it'} cannot be read: {error.strerror or error}"
    return str(error)


def _error(code: str, place: Path, message: str, *, expected: str = "", found: str = "", hint: str = "") -> Diagnostic:
    return Diagnostic(code, Severity.ERROR, Position(str(place)), message, "", expected, found, hint)
