"""The wheels of one bundle: our own, built from the installed package, and those it needs, from a directory or pip.

`own_wheel` -> `fetch` (only without a directory) -> `choose` (one wheel for each requirement, the newest that the
target takes).
"""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import io
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from meshctl.errors import InputError
from meshctl.robots.wheel_tags import Target, WheelName, is_compatible, parse_wheel, pip_options

# What udp_mesh imports besides the standard library, and what that needs in turn.
REQUIREMENTS = ("cryptography", "cffi", "pycparser")
_PACKAGE = "udp_mesh"
# Every entry gets it, so that the same sources make the same bytes; zip knows no earlier time.
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
# Compiled files are a little smaller than their sources.
_COMPILED_SHARE = 0.9
_PIP_TIMEOUT_S = 600


@dataclass(frozen=True, slots=True)
class Wheel:
    """A wheel's bytes under its file name; `unpacked_bytes` is what it takes on a disk, compiled."""

    file: str
    content: bytes = field(repr=False)
    unpacked_bytes: int

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.content).hexdigest()

    @property
    def stored(self) -> str:
        """Its name on a robot: two wheels with one name but other bytes never meet there."""
        return f"{self.sha256[:16]}-{self.file}"


def _wheel(file: str, content: bytes) -> Wheel:
    """Raises InputError for what is no archive, or would not install by unpacking alone."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
    except zipfile.BadZipFile as error:
        raise InputError(f"{file}: is no wheel: {error}", hint="fetch it again") from error
    if any(".data/" in entry.filename for entry in entries):
        raise InputError(f"{file}: has a .data directory, which only an installer places")
    sources = sum(entry.file_size for entry in entries if entry.filename.endswith(".py"))
    return Wheel(file, content, sum(entry.file_size for entry in entries) + int(sources * _COMPILED_SHARE))


@cache
def own_wheel() -> Wheel:
    """udp_mesh alone as a wheel, without meshctl and what that depends on."""
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None or spec.origin is None:
        raise InputError(f"the package {_PACKAGE} is not installed beside meshctl")
    return build_wheel(Path(spec.origin).parent)


def build_wheel(package: Path) -> Wheel:
    """A wheel of the package in this directory, always the same for the same files."""
    files = {
        f"{_PACKAGE}/{path.relative_to(package).as_posix()}": path.read_bytes()
        for path in sorted(package.rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
    }
    stated = re.search(rb'^__version__ = "([^"]+)"', files[f"{_PACKAGE}/__init__.py"], re.MULTILINE)
    version = stated[1].decode() if stated else "0"
    info = f"{_PACKAGE}-{version}.dist-info"
    files[f"{info}/METADATA"] = (
        f"Metadata-Version: 2.1\nName: udp-mesh\nVersion: {version}\nRequires-Python: >=3.11\n"
        "License: Apache-2.0\nRequires-Dist: cryptography>=42\n"
    ).encode()
    files[f"{info}/WHEEL"] = b"Wheel-Version: 1.0\nGenerator: meshctl\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    files[f"{info}/entry_points.txt"] = b"[console_scripts]\nudp-mesh = udp_mesh.cli.main:main\n"
    record = "".join(f"{name},sha256={_urlsafe(content)},{len(content)}\n" for name, content in files.items())
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n".encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _ZIP_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return _wheel(f"{_PACKAGE}-{version}-py3-none-any.whl", out.getvalue())


def _urlsafe(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")


def download_wheels(target: Target, directory: Path) -> None:
    """Let pip download the requirements for a target into `directory`, on the operator's machine. Raises InputError."""
    directory.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary", ":all:", "--dest", str(directory), *pip_options(target), *REQUIREMENTS]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PIP_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"pip could not fetch wheels for {target}: {error}") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "it said nothing").splitlines()[-1]
        hint = "without internet give the wheels: --wheels DIR"
        raise InputError(f"pip could not fetch wheels for {target}: {last}", hint=hint)


def select_wheels(target: Target, directory: Path) -> tuple[Wheel, ...]:
    """Our own wheel and one for each requirement. Raises InputError naming what is missing and what is there."""
    try:
        names = [parse_wheel(path.name) for path in sorted(directory.iterdir()) if path.suffix == ".whl"]
    except OSError as error:
        raise InputError(f"{directory}: cannot be read: {error.strerror}") from error
    wheels = [name for name in names if name is not None]
    picked = [own_wheel()]
    missing = []
    for project in REQUIREMENTS:
        of_project = [wheel for wheel in wheels if wheel.project == project]
        fitting = [wheel for wheel in of_project if is_compatible(target, wheel)]
        if not fitting:
            there = ", ".join(wheel.file for wheel in of_project) or "none at all"
            missing.append(f"{directory}: expected a wheel of {project} for {target}, found {there}")
            continue
        best = max(fitting, key=_age)
        path = directory / best.file
        try:
            picked.append(_wheel(best.file, path.read_bytes()))
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if missing:
        version = ".".join(map(str, target.python))
        words = f"pip download --only-binary :all: --python-version {version} --platform manylinux2014_{target.arch}"
        hint = f"fetch them where there is internet: {words} -d DIR {' '.join(REQUIREMENTS)}"
        raise InputError("\n".join(missing), hint=hint)
    return tuple(picked)


def has_all(target: Target, directory: Path) -> bool:
    """Whether `select_wheels` would find everything there."""
    if not directory.is_dir():
        return False
    there = [wheel for wheel in map(parse_wheel, (path.name for path in directory.iterdir())) if wheel is not None]
    return all(
        any(wheel.project == project and is_compatible(target, wheel) for wheel in there) for project in REQUIREMENTS
    )


def cache_wheels(wheels: Iterable[Wheel], directory: Path) -> None:
    """Make these the wheels that a later command finds in `directory` without being told. Raises InputError."""
    wanted = {wheel.file: wheel for wheel in wheels if parse_wheel(wheel.file) != parse_wheel(own_wheel().file)}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, wheel in wanted.items():
            if not (directory / name).exists():
                partial = directory / f".{name}.part"
                partial.write_bytes(wheel.content)
                partial.replace(directory / name)
        for path in directory.glob("*.whl"):
            if path.name not in wanted:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}") from error


def _age(wheel: WheelName) -> tuple[tuple[int, ...], str]:
    """Versions by their numbers; a tie by the file's name, so that the choice is always the same."""
    return tuple(int(part) for part in re.findall(r"\d+", wheel.version)), wheel.file


@cache
def stock_units() -> Mapping[str, str]:
    """The unit files that udp_mesh ships, by name."""
    folder = f"{_PACKAGE}/daemon/units/"
    with zipfile.ZipFile(io.BytesIO(own_wheel().content)) as archive:
        return {
            name.removeprefix(folder): archive.read(name).decode()
            for name in archive.namelist()
            if name.startswith(folder) and name.endswith(".service")
        }
