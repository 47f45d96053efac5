"""The firmware images of hardware profiles, checked once each, by what needs no device."""

from __future__ import annotations

from pathlib import Path

from meshctl.diagnostics import Diagnostic, InvalidInput
from meshctl.errors import InputError
from meshctl.firmware import check, image_path
from meshctl.model import HardwareProfile


def checked_image(profile: HardwareProfile) -> Path:
    """The profile's image, after every check that needs no device. Raises InvalidInput, InputError."""
    path = image_path(profile)
    if path is None:
        raise InputError(f"hardware {profile.name}: the inventory names no firmware image")
    problems = check(path, profile)
    if problems:
        raise InvalidInput(problems)
    return path


class CheckedImages:
    """Faults of firmware images, each of which is read once."""

    def __init__(self) -> None:
        self._faults: dict[str, str] = {}

    def faults(self, profile: HardwareProfile) -> str:
        """Why no node can be flashed with the profile's image; empty if nothing is wrong with it."""
        if profile.name not in self._faults:
            path = image_path(profile)
            self._faults[profile.name] = "" if path is None else "; ".join(map(_text, check(path, profile)))
        return self._faults[profile.name]


def _text(fault: Diagnostic) -> str:
    found = f": expected {fault.expected}, found {fault.found}" if fault.expected else ""
    return f"its firmware image {Path(fault.position.file).name}: {fault.message}{found} [{fault.code}]"
