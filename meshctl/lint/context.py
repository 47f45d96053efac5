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
SecretProblem = Callable[[SecretRef], str]


class Files(Protocol):
    """Facts about files that an inventory names; None where there is no such file."""

    def size_bytes(self, path: Path) -> int | None: ...

    def mode(self, path: Path) -> int | None:
        """The permission bits."""

    def text(self, path: Path) -> str | None:
        """The whole file; a replacement character stands for what is not UTF-8."""

    def is_special(self, path: Path) -> bool:
        """Whether something stands there that is no regular file: a directory, a device."""

    def in_repository(self, path: Path) -> bool:
        """Whether git would take the file into a repository: inside a work tree, and not ignored."""

    def firmware(self, profile: HardwareProfile) -> tuple[Diagnostic, ...]:
        """What `meshctl.firmware.check` says of the profile's image."""

    def image_version(self, profile: HardwareProfile) -> str:
        """OpenWrt's version in the metadata of the profile's image (`25.12.0-rc1`); empty where it is not known."""


def no_secret(_ref: SecretRef) -> Secret | None:
    """The lookup of a machine that holds no secrets (continuous integration)."""
    return None


def no_problem(_ref: SecretRef) -> str:
    """What is wrong with the places of secrets, on a machine that has none of them."""
    return ""


@dataclass(frozen=True, slots=True)
class LintContext:
    """`secret` gives None where a secret is not at hand; rules about its strength are then silent. `secret_problem`
    says why a place that is at hand (a file that exists, a variable that is set) has no secret; empty for any other."""

    regdb: Regdb
    files: Files
    secret: SecretLookup = no_secret
    secret_problem: SecretProblem = no_problem
