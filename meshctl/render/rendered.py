"""The result of rendering: a node's files, as bytes for the node and as masked text for display."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from meshctl import uci
from meshctl.model import MASK, Secret

# The marker that identifies a device's node and configuration: lines of `key=value`.
MARKER_PATH = "etc/meshctl/node"
CONFIG_FOLDER = "etc/config/"
# Run by the firewall; only nodes with `lan_filter` have it.
LAN_FILTER_PATH = "etc/meshctl/lan-filter.sh"
# All that the key of a collector may run; only radios of robots with one have it.
LINKS_PATH = "etc/meshctl/links.sh"


@dataclass(frozen=True, slots=True)
class RenderedFile:
    """One file: `path` from the device's root without a leading slash, `content` with secrets, `masked` without.

    `package` is the tree of a UCI file (under etc/config), None for others. `secrets` are the secrets in the file; a
    file with secrets is readable by root only.
    """

    path: str
    mode: int
    content: bytes = field(repr=False)
    masked: str
    secrets: tuple[Secret, ...] = ()
    package: uci.Package | None = field(default=None, repr=False)

    def hide(self, text: str) -> str:
        """`text`, such as a line of a diff, with this file's secrets masked."""
        return replace_secrets(text, self.secrets, lambda _: MASK)


def replace_secrets(text: str, secrets: tuple[Secret, ...], replacement: Callable[[Secret], str]) -> str:
    """`text` with every secret replaced, both in UCI quoting and in plain text."""
    # longest first, in case one secret contains another
    for secret in sorted(secrets, key=lambda secret: -len(secret.reveal())):
        for form in (uci.quote(secret.reveal())[1:-1], secret.reveal()):
            text = text.replace(form, replacement(secret))
    return text


@dataclass(frozen=True, slots=True)
class Rendered:
    """All files of one node, sorted by path, including the marker; `packages` to install on a stock image, and
    `removed_packages` to remove from it. `config_hash` identifies the configuration (64 hex digits)."""

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
        """All files for display, secrets masked."""
        return "".join(f"# /{file.path} ({file.mode:04o})\n{file.masked.rstrip()}\n\n" for file in self.files)
