"""What rendering gives: a node's files, with the bytes for the node and a text for people."""

from __future__ import annotations

from dataclasses import dataclass, field

from meshctl import uci

# The marker that tells which node's and which configuration a device carries: lines of `key=value`.
MARKER_PATH = "etc/meshctl/node"
CONFIG_FOLDER = "etc/config/"


@dataclass(frozen=True, slots=True)
class RenderedFile:
    """One file: `path` from the device's root without a leading slash, `content` with secrets, `masked` without.

    `package` is the tree of a UCI file (under etc/config), None of any other; `has_secret` files have mode 0600.
    """

    path: str
    mode: int
    content: bytes = field(repr=False)
    masked: str
    has_secret: bool = False
    package: uci.Package | None = field(default=None, repr=False)


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
