"""The wheels of one bundle: our own, built from the installed package, and its requirements, from a directory or pip.

`own_wheel` -> `download_wheels` (only without a directory) -> `select_wheels` (the newest compatible wheel of each
requirement).
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

# Dependencies of udp_mesh, direct and transitive.
REQUIREMENTS = ("cryptography", "cffi", "pycparser")
# Only for differences and zstd, and part of Python from 3.14 on. A robot without it gets plain messages.
_ZSTD = "backports-zstd"
_ZSTD_ARCHITECTURES = ("x86_64", "aarch64")
_PACKAGE = "udp_mesh"
# The earliest zip timestamp, for reproducible wheels.
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
# Size of .pyc files relative to their sources.
_COMPILED_SHARE = 0.9
_PIP_TIMEOUT_S = 600


def requirements(target: Target) -> tuple[str, ...]:
    """The projects of which a target needs a wheel."""
    has_wheel = target.arch in _ZSTD_ARCHITECTURES and target.python < (3, 14)
    return (*REQUIREMENTS, _ZSTD) if has_wheel else REQUIREMENTS


@dataclass(frozen=True, slots=True)
class Wheel:
    """A wheel file; `unpacked_bytes` is its size on disk, compiled."""

    file: str
    content: bytes = field(repr=False)
    unpacked_bytes: int

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.content).hexdigest()

    @property
    def stored(self) -> str:
        """Its file name on a robot, unique by content."""
        return f"{self.sha256[:16]}-{self.file}"


def _wheel(file: str, content: bytes) -> Wheel:
    """Raises InputError for an invalid archive, and for one that cannot be installed by unpacking."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
    except zipfile.BadZipFile as error:
        raise InputError(f"{file} is not a wheel: {error}", hint="download it again") from error
    if any(".data/" in entry.filename for entry in entries):
        raise InputError(f"{file} has a .data directory, which requires an installer")
    sources = sum(entry.file_size for entry in entries if entry.filename.endswith(".py"))
    return Wheel(file, content, sum(entry.file_size for entry in entries) + int(sources * _COMPILED_SHARE))


@cache
def own_wheel() -> Wheel:
    """udp_mesh as a wheel, without meshctl and its dependencies."""
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None or spec.origin is None:
        raise InputError(f"package {_PACKAGE} is not installed")
    return build_wheel(Path(spec.origin).parent)


def build_wheel(package: Path) -> Wheel:
    """A reproducible wheel of the package in this directory."""
    files = {
        f"{_PACKAGE}/{path.relative_to(package).as_posix()}": path.read_bytes()
        for path in sorted(package.rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
    }
    stated = re.search(rb'^__version__ = "([^"]+)"', files[f"{_PACKAGE}/__init__.py"], re.MULTILINE)
    version = stated[1].decode() if stated else "0"
    metadata = (
        "Requires-Python: >=3.11\nLicense: Apache-2.0\nRequires-Dist: cryptography>=42\n"
        "Requires-Dist: backports.zstd>=1.0; python_version < '3.14'\n"
    )
    info = dist_info("udp-mesh", version)
    files[f"{info}/entry_points.txt"] = b"[console_scripts]\nudp-mesh = udp_mesh.cli.main:main\n"
    return wheel_of("udp-mesh", version, files, metadata)


def dist_info(project: str, version: str) -> str:
    """The directory of a wheel's metadata."""
    return f"{project.replace('-', '_')}-{version}.dist-info"


def wheel_of(project: str, version: str, contents: Mapping[str, bytes], metadata: str) -> Wheel:
    """A reproducible wheel of these files for any Python; `metadata` are further lines of METADATA."""
    info = dist_info(project, version)
    files = dict(contents)
    files[f"{info}/METADATA"] = f"Metadata-Version: 2.1\nName: {project}\nVersion: {version}\n{metadata}".encode()
    files[f"{info}/WHEEL"] = b"Wheel-Version: 1.0\nGenerator: meshctl\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    record = "".join(f"{name},sha256={_urlsafe(content)},{len(content)}\n" for name, content in files.items())
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n".encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _ZIP_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return _wheel(f"{info.removesuffix('.dist-info')}-py3-none-any.whl", out.getvalue())


def _urlsafe(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")


def download_wheels(target: Target, directory: Path) -> None:
    """Download the requirements for a target into `directory` with pip. Raises InputError."""
    directory.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-P", "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary", ":all:", "--dest", str(directory), *pip_options(target), *requirements(target)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PIP_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"pip could not download wheels for {target}: {error}") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "no error message").splitlines()[-1]
        hint = "without internet access, pass --wheels DIR"
        raise InputError(f"pip could not download wheels for {target}: {last}", hint=hint)


def select_wheels(target: Target, directory: Path) -> tuple[Wheel, ...]:
    """Our own wheel and one per requirement. Raises InputError with the missing and the available ones."""
    try:
        names = [parse_wheel(path.name) for path in sorted(directory.iterdir()) if path.suffix == ".whl"]
    except OSError as error:
        raise InputError(f"cannot read {directory}: {error.strerror}") from error
    wheels = [name for name in names if name is not None]
    picked = [own_wheel()]
    missing = []
    for project in requirements(target):
        of_project = [wheel for wheel in wheels if wheel.project == project]
        fitting = [wheel for wheel in of_project if is_compatible(target, wheel)]
        if not fitting:
            there = ", ".join(wheel.file for wheel in of_project) or "none"
            missing.append(f"{directory}: expected a wheel of {project} for {target}, found {there}")
            continue
        best = max(fitting, key=_age)
        path = directory / best.file
        try:
            picked.append(_wheel(best.file, path.read_bytes()))
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}") from error
    if missing:
        version = ".".join(map(str, target.python))
        words = f"pip download --only-binary :all: --python-version {version} --platform manylinux2014_{target.arch}"
        hint = f"download them with internet access: {words} -d DIR {' '.join(requirements(target))}"
        raise InputError("\n".join(missing), hint=hint)
    return tuple(picked)


def has_all(target: Target, directory: Path) -> bool:
    """Whether `select_wheels` would find everything."""
    if not directory.is_dir():
        return False
    there = [wheel for wheel in map(parse_wheel, (path.name for path in directory.iterdir())) if wheel is not None]
    return all(
        any(wheel.project == project and is_compatible(target, wheel) for wheel in there)
        for project in requirements(target)
    )


def cache_wheels(wheels: Iterable[Wheel], directory: Path) -> None:
    """Make these the only wheels in the cache `directory`, for later commands without --wheels. Raises InputError."""
    keep = {wheel.file: wheel for wheel in wheels if parse_wheel(wheel.file) != parse_wheel(own_wheel().file)}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, wheel in keep.items():
            if not (directory / name).exists():
                partial = directory / f".{name}.part"
                partial.write_bytes(wheel.content)
                partial.replace(directory / name)
        for path in directory.glob("*.whl"):
            if path.name not in keep:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {directory}: {error.strerror}") from error


def _age(wheel: WheelName) -> tuple[tuple[int, ...], str]:
    """Sort key: version numbers, then the file name, so that the choice is deterministic."""
    return tuple(int(part) for part in re.findall(r"\d+", wheel.version)), wheel.file


@cache
def stock_units() -> Mapping[str, str]:
    """The unit files shipped with udp_mesh, by name."""
    folder = f"{_PACKAGE}/daemon/units/"
    with zipfile.ZipFile(io.BytesIO(own_wheel().content)) as archive:
        return {
            name.removeprefix(folder): archive.read(name).decode()
            for name in archive.namelist()
            if name.startswith(folder) and name.endswith(".service")
        }
