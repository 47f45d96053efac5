"""What rendering gives: a node's files, with the bytes for the node and a text for people."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from meshctl import uci
from meshctl.model import MASK, Secret

# The marker that tells which node's and which configuration a device carries: lines of `key=value`.
MARKER_PATH = "etc/meshctl/node"
CONFIG_FOLDER = "etc/config/"


@dataclass(frozen=True, slots=True)
class RenderedFile:
    """One file: `path` from the device's root without a leading slash, `content` with secrets, `masked` without.

    `package` is the tree of a UCI file (under etc/config), None of any other; `secrets` are those in it: a file with
    any is open to root alone.
    """

    path: str
    mode: int
    content: bytes = field(repr=False)
    masked: str
    secrets: tuple[Secret, ...] = ()
    package: uci.Package | None = field(default=None, repr=False)

    def hide(self, text: str) -> str:
        """`text`, for instance a line of a difference, with this file's secrets masked."""
        return replace_secrets(text, self.secrets, lambda _: MASK)


def replace_secrets(text: str, secrets: tuple[Secret, ...], replacement: Callable[[Secret], str]) -> str:
    """`text` with every secret replaced, both as it is written in UCI and as it is."""
    # the longest first, so that no secret inside another leaves half of it behind
    for secret in sorted(secrets, key=lambda secret: -len(secret.reveal())):
        for form in (uci.quote(secret.reveal())[1:-1], secret.reveal()):
            text = text.replace(form, replacement(secret))
    return text


@dataclass(frozen=True, slots=True)
class Rendered:
    """All files of one node, sorted by path, the marker among them; `packages` to install on top of a stock image,
    `removed_packages` to take out of it. `config_hash` names this configuration (64 hex digits)."""

    node: str
    release: str
    files: tuple[RenderedFile, ...]
    packages: tuple[str, ...]
    removed_packages: tuple[str, ...]
    config_hash: str

    def file(self, path: str) -> RenderedFile | None:
        """The file at `path`, or None."""
        return next((file for file in self.files if file.path == path), None)

    def package(self, name: str) -> uci.Package | None:
        """The tree of `etc/config/NAME`, or None."""
        file = self.file(CONFIG_FOLDER + name)
        return file.package if file is not None else None

    @property
    def masked_text(self) -> str:
        """All files for a person to read, secrets masked."""
        return "".join(f"# /{file.path} ({file.mode:04o})\n{file.masked.rstrip()}\n\n" for file in self.files)
