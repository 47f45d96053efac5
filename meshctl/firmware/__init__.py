"""OpenWrt images: trailers -> metadata -> board, release and revision; and their hash and signature."""

from meshctl.firmware.check import check, image_path, image_version, is_revision, sha256
from meshctl.firmware.metadata import Metadata, parse_metadata, read_metadata
from meshctl.firmware.trailer import (
    DamagedImage,
    Trailer,
    TrailerType,
    append_metadata,
    append_signature,
    read_trailers,
)
from meshctl.firmware.usign import BadSignature, PublicKey, parse_public_key, verify

__all__ = [
    "BadSignature",
    "DamagedImage",
    "Metadata",
    "PublicKey",
    "Trailer",
    "TrailerType",
    "append_metadata",
    "append_signature",
    "check",
    "image_path",
    "image_version",
    "is_revision",
    "parse_metadata",
    "parse_public_key",
    "read_metadata",
    "read_trailers",
    "sha256",
    "verify",
]
