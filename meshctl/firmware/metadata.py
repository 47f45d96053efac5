"""An image's metadata: its version, target and supported boards, from JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from meshctl.firmware.trailer import DamagedImage, TrailerType, read_trailers


@dataclass(frozen=True, slots=True)
class Metadata:
    """`boards` are the supported boards, named as in `ubus call system board`; `compat_version` above 1.0 means that
    the configuration cannot be kept. A field is empty if the metadata lacks it."""

    boards: tuple[str, ...]
    compat_version: str = "1.0"
    distribution: str = ""
    version: str = ""
    revision: str = ""
    target: str = ""
    profile: str = ""


def read_metadata(image: bytes) -> Metadata | None:
    """The metadata of an image, None if it has none. Raises DamagedImage if it is unreadable."""
    for trailer in read_trailers(image):
        if not trailer.is_intact:
            raise DamagedImage("checksum mismatch: the image is truncated or modified")
        if trailer.type is TrailerType.INFO:
            return parse_metadata(trailer.data)
    return None


def parse_metadata(text: bytes) -> Metadata:
    """Parse the metadata's JSON (include/image-commands.mk, metadata_json). Raises DamagedImage for anything else."""
    try:
        # it may end with a NUL or a newline
        document = json.loads(text.rstrip(b"\0\n").decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DamagedImage(f"expected metadata in JSON, found something else: {error}") from error
    if not isinstance(document, dict):
        raise DamagedImage("expected metadata as a JSON object, found something else")
    version = document.get("version")
    about: Mapping[str, Any] = version if isinstance(version, dict) else {}
    compat_version = _text(document, "compat_version") or "1.0"
    # an image that is incompatible with older configurations hides its boards from older releases under another key
    names = _texts(document, "supported_devices" if compat_version == "1.0" else "new_supported_devices")
    return Metadata(
        boards=names or _texts(document, "supported_devices"),
        compat_version=compat_version,
        distribution=_text(about, "dist"),
        version=_text(about, "version"),
        revision=_text(about, "revision"),
        target=_text(about, "target"),
        profile=_text(about, "board"),
    )


def _text(document: Mapping[str, Any], key: str) -> str:
    value = document.get(key, "")
    if not isinstance(value, str):
        raise DamagedImage(f"expected text in the metadata's {key}, found {type(value).__name__}")
    return value


def _texts(document: Mapping[str, Any], key: str) -> tuple[str, ...]:
    value = document.get(key, [])
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise DamagedImage(f"expected a list of texts in the metadata's {key}, found something else")
    return tuple(value)
