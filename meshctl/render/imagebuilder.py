"""Input for OpenWrt's ImageBuilder: images with nodes' configurations and packages.

One folder per hardware and release: `files/NODE/` overlays, `packages.txt`, and `build.sh` with the `make image` call
of every node, to be run inside the unpacked ImageBuilder. Nodes in the field have no internet access, so packages are
part of the image.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from meshctl.inventory.file_paths import file_path
from meshctl.model import Fleet, HardwareProfile, Node, Release
from meshctl.render.rendered import Rendered, RenderedFile
from meshctl.resolve import package_files


@dataclass(frozen=True, slots=True)
class ImageFolder:
    """One folder for the ImageBuilder of `release` and the hardware's target; `overlays` are by node."""

    name: str
    hardware: HardwareProfile
    release: Release
    overlays: tuple[Rendered, ...]
    package_files: tuple[Path, ...]

    @property
    def packages_text(self) -> str:
        """All packages of the nodes, and removed packages prefixed with `-`, one per line."""
        wanted = sorted({name for node in self.overlays for name in node.packages})
        removed = sorted({f"-{name}" for node in self.overlays for name in node.removed_packages})
        return "".join(f"{name}\n" for name in (*wanted, *removed))

    @property
    def script(self) -> str:
        """The shell script with the calls of all nodes."""
        return "".join(f"{line}\n" for line in (*_HEAD, *self._about(), *_SETUP, *self._copies(), *self._calls()))

    def make_call(self, rendered: Rendered) -> str:
        """The `make image` call of one node."""
        packages = " ".join((*rendered.packages, *(f"-{name}" for name in rendered.removed_packages)))
        return (
            f"make image PROFILE={shlex.quote(self.hardware.profile)} PACKAGES={shlex.quote(packages)}"
            f' FILES="$here"/files/{shlex.quote(rendered.node)} EXTRA_IMAGE_NAME={shlex.quote(rendered.node)}'
        )

    def _about(self) -> tuple[str, ...]:
        return (f"# Builds for {self.hardware.board} with the ImageBuilder of {self.release}, {self.hardware.target}.",)

    def _copies(self) -> tuple[str, ...]:
        return tuple(f"cp {shlex.quote(str(path))} packages/" for path in self.package_files)

    def _calls(self) -> tuple[str, ...]:
        return tuple(
            line
            for node in self.overlays
            for line in (f"if wanted {shlex.quote(node.node)}; then", f"\t{self.make_call(node)}", "fi")
        )


_HEAD = ("#!/bin/sh",)
_SETUP = (
    "# Run it in the unpacked ImageBuilder; name nodes to build only theirs. The images carry keys: keep them private.",
    "set -eu",
    'here=$(CDPATH="" cd -- "$(dirname -- "$0")" && pwd)',
    'names=" $* "',
    'wanted() { case "$names" in "  " | *" $1 "*) return 0 ;; esac; return 1; }',
)


def image_folders(fleet: Fleet, rendered: Iterable[Rendered]) -> tuple[ImageFolder, ...]:
    """The nodes grouped by hardware and release, in the inventory's order."""
    groups: dict[tuple[str, Release], list[Rendered]] = {}
    for item in rendered:
        node = fleet.nodes[item.node]
        groups.setdefault((node.hardware.name, node.release), []).append(item)
    return tuple(
        ImageFolder(
            name=f"{name}-{release}",
            hardware=fleet.nodes[items[0].node].hardware,
            release=release,
            overlays=tuple(items),
            package_files=_package_files(fleet, [fleet.nodes[item.node] for item in items]),
        )
        for (name, release), items in groups.items()
    )


def _package_files(fleet: Fleet, nodes: list[Node]) -> tuple[Path, ...]:
    """Package files of the hardware and of the nodes' back ends, as absolute paths, each once."""
    files = dict.fromkeys(file for node in nodes for file in package_files(fleet, node))
    return tuple(dict.fromkeys(file_path(fleet, file).resolve() for file in files))


def folder_files(folder: ImageFolder) -> tuple[RenderedFile, ...]:
    """All files of the folder, with overlays below `files/NODE/`."""
    files = [
        RenderedFile(f"files/{node.node}/{file.path}", file.mode, file.content, file.masked, file.secrets)
        for node in folder.overlays
        for file in node.files
    ]
    files.append(RenderedFile("packages.txt", 0o644, folder.packages_text.encode(), folder.packages_text))
    files.append(RenderedFile("build.sh", 0o755, folder.script.encode(), folder.script))
    return tuple(files)
