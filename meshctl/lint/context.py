"""Inputs of rules besides the fleet: the regulatory database, files, secrets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from meshctl.diagnostics import Diagnostic
from meshctl.lint.trial_rendering import TrialRendering
from meshctl.model import HardwareProfile, Secret, SecretRef
from meshctl.regdb import Regdb

SecretLookup = Callable[[SecretRef], Secret | None]
SecretProblem = Callable[[SecretRef], str]


class Files(Protocol):
    """Facts about files that an inventory names; None for a missing file."""

    def size_bytes(self, path: Path) -> int | None: ...

    def mode(self, path: Path) -> int | None:
        """The permission bits."""

    def text(self, path: Path) -> str | None:
        """The whole file, with replacement characters for invalid UTF-8."""

    def is_special(self, path: Path) -> bool:
        """Whether the path exists but is not a regular file."""

    def inside(self, folder: Path) -> tuple[Path, ...]:
        """The regular files directly in a folder, by name; none if there are very many."""

    def in_repository(self, path: Path) -> bool:
        """Whether git would commit the file: it is inside a work tree, and not ignored."""

    def firmware(self, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
        """The result of `meshctl.firmware.check` for the profile's image."""

    def image_version(self, profile: HardwareProfile) -> str:
        """OpenWrt's version in the metadata of the profile's image (`25.12.0-rc1`); empty if unknown."""


def no_secret(_ref: SecretRef) -> Secret | None:
    """Lookup on a machine without secrets, such as a CI runner."""
    return None


def no_problem(_ref: SecretRef) -> str:
    """Problems with secrets on a machine that has none: never any."""
    return ""


@dataclass(frozen=True, slots=True)
class LintContext:
    """`secret` returns None for an unavailable secret; rules about its strength are then silent. `secret_problem`
    returns why an existing file or variable yields no secret, and an empty string otherwise."""

    regdb: Regdb
    files: Files
    secret: SecretLookup = no_secret
    secret_problem: SecretProblem = no_problem
    trial: TrialRendering = field(default_factory=TrialRendering)
