"""What rules may look at besides the fleet: regulatory rules, files, secrets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from meshctl.diagnostics import Diagnostic
from meshctl.model import HardwareProfile, Secret, SecretRef
from meshctl.regdb import Regdb

SecretLookup = Callable[[SecretRef], Secret | None]


class Files(Protocol):
    """Facts about files that an inventory names; None where there is no such file."""

    def size_bytes(self, path: Path) -> int | None: ...

    def mode(self, path: Path) -> int | None:
        """The permission bits."""

    def text(self, path: Path) -> str | None:
        """The whole file; a replacement character stands for what is not UTF-8."""

    def in_repository(self, path: Path) -> bool:
        """Whether git would take the file into a repository: inside a work tree, and not ignored."""

    def firmware(self, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
        """What `meshctl.firmware.check` says of the profile's image."""


def no_secret(_ref: SecretRef) -> Secret | None:
    """The lookup of a machine that holds no secrets (continuous integration)."""
    return None


@dataclass(frozen=True, slots=True)
class LintContext:
    """`secret` gives None where a secret is not at hand; rules about its strength are then silent."""

    regdb: Regdb
    files: Files
    secret: SecretLookup = no_secret
