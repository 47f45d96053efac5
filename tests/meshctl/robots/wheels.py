"""Wheels for tests, made of the packages that the tests themselves run with: no network, the same bytes each time."""

from __future__ import annotations

import importlib.metadata
import re
import shutil
import sys
import zipfile
from pathlib import Path

import udp_mesh
from meshctl.robots.wheels import REQUIREMENTS, Wheel, build_wheel

ZSTD = ("backports.zstd",) if sys.version_info < (3, 14) else ()


def repack(directory: Path, projects: tuple[str, ...] = (*REQUIREMENTS, *ZSTD)) -> Path:
    """Write one wheel for each project into `directory`, with the tags it was installed with."""
    directory.mkdir(parents=True, exist_ok=True)
    for project in projects:
        found = importlib.metadata.distribution(project)
        tags = [line.removeprefix("Tag: ") for line in (found.read_text("WHEEL") or "").splitlines() if "Tag: " in line]
        parts = [sorted({tag.split("-")[number] for tag in tags}) for number in range(3)]
        tag = "-".join(".".join(part) for part in parts)
        # the form of names in wheels' files (PyPA binary distribution format)
        name = re.sub(r"[-_.]+", "_", project).lower()
        path = directory / f"{name}-{found.version}-{tag}.whl"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for file in sorted(found.files or (), key=str):
                if ".." in file.parts or "__pycache__" in file.parts:
                    continue
                entry = zipfile.ZipInfo(str(file), (1980, 1, 1, 0, 0, 0))
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, Path(str(file.locate())).read_bytes())
    return directory


def own_wheel_with(directory: Path, module: str, old: str, new: str) -> Wheel:
    """udp_mesh's wheel with one text in one module replaced: another version of it."""
    package = directory / "udp_mesh"
    shutil.rmtree(package, ignore_errors=True)
    shutil.copytree(Path(udp_mesh.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    text = (package / module).read_text()
    assert old in text, f"{module} has no {old!r}"
    (package / module).write_text(text.replace(old, new))
    return build_wheel(package)
