"""Wheels for tests, made of the packages that the tests themselves run with: no network, the same bytes each time."""

from __future__ import annotations

import importlib.metadata
import zipfile
from pathlib import Path

from meshctl.robots.wheels import REQUIREMENTS


def repack(directory: Path, projects: tuple[str, ...] = REQUIREMENTS) -> Path:
    """Write one wheel for each project into `directory`, with the tags it was installed with."""
    directory.mkdir(parents=True, exist_ok=True)
    for project in projects:
        found = importlib.metadata.distribution(project)
        tags = [line.removeprefix("Tag: ") for line in (found.read_text("WHEEL") or "").splitlines() if "Tag: " in line]
        parts = [sorted({tag.split("-")[number] for tag in tags}) for number in range(3)]
        tag = "-".join(".".join(part) for part in parts)
        path = directory / f"{project}-{found.version}-{tag}.whl"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for file in sorted(found.files or (), key=str):
                if ".." in file.parts or "__pycache__" in file.parts:
                    continue
                entry = zipfile.ZipInfo(str(file), (1980, 1, 1, 0, 0, 0))
                archive.writestr(entry, Path(str(file.locate())).read_bytes())
    return directory
