"""Installing the worker on a site's gateway: probe -> wheels for its Python -> one archive -> unpack and switch.

A release is a directory of unpacked wheels and a start script, named by the hash of both; `current` points to the one
in use, so that a worker that executes a run keeps its files. Nothing needs root there, pip, or the internet.
"""

from __future__ import annotations

import gzip
import hashlib
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import distribution, entry_points
from pathlib import Path, PurePosixPath

from meshctl import __version__
from meshctl.archive import TarMember, tar_of
from meshctl.device.connection import Connection
from meshctl.device.upload import UploadProgress, upload
from meshctl.errors import InputError
from meshctl.resources import shipped
from meshctl.robots.preconditions import parse_facts
from meshctl.robots.wheel_tags import Target, pip_options

# In the login user's home directory, where the worker's commands start.
GATEWAY_ROOT = ".local/share/meshctl"
WORKER_PROGRAM = f"~/{GATEWAY_ROOT}/current/bin/meshctl worker"
OLDEST_PYTHON = (3, 11)
# the project's name in pyproject.toml
_DISTRIBUTION = "meshctl-fleet"
_OWN_PACKAGES = ("meshctl", "meshlab")
_SHIPPED = ("templates", "inventory", "lint")
_EXTENSIONS = "meshctl.extensions"
_PIP_TIMEOUT_S = 600
_INSTALL_TIMEOUT_S = 600.0
_KEPT_RELEASES = 3
# gzip level: the highest takes four times as long for one percent
_LEVEL = 6
_DIGITS = 16

_PROBE = """
echo "arch=$(uname -m)"
python=$(command -v python3) || exit 0
"$python" -c '
import struct, sys, platform
print("python=%d.%d.%d" % tuple(sys.version_info[:3]))
print("implementation=" + platform.python_implementation())
print("bits=%d" % (8 * struct.calcsize("P")))
print("libc=" + " ".join(platform.libc_ver()))
print("executable=" + sys.executable)
'
"""
# argv: the root in the home directory, the release, its Python, how many releases are kept
_INSTALL = """
set -eu
umask 077
cd "$HOME/$1"
if [ ! -d "releases/$2" ]; then
	rm -rf "releases/.$2.new"
	mkdir -p "releases/.$2.new"
	"$3" -W ignore -c 'import sys, tarfile
with tarfile.open(sys.argv[1]) as tar:
    tar.extractall(sys.argv[2])' "uploads/$2.tar.gz" "releases/.$2.new"
	mv "releases/.$2.new" "releases/$2"
fi
"releases/$2/bin/meshctl" --version >/dev/null
ln -sfn "releases/$2" .current.new
mv -fT .current.new current
touch "releases/$2"
rm -rf uploads
ls -t releases | tail -n +$(($4 + 1)) | while read -r old; do rm -rf "releases/$old"; done
"""
_START = """#!/bin/sh
# Starts the meshctl of this release, also through a link to it.
here=$(dirname "$(dirname "$(readlink -f "$0")")")
PYTHONPATH=$here/lib exec {python} -m meshctl "$@"
"""


@dataclass(frozen=True, slots=True)
class Gateway:
    """A probed gateway: the wheels' target and the absolute path of its Python."""

    target: Target
    executable: str


@dataclass(frozen=True, slots=True)
class WorkerRelease:
    """`archive` is a gzipped tar with `bin/meshctl` and `lib/`."""

    archive: bytes = field(repr=False)

    @property
    def id(self) -> str:
        return hashlib.sha256(self.archive).hexdigest()[:_DIGITS]


def probe(connection: Connection) -> Gateway:
    """Raises InputError for a gateway without a usable Python."""
    label = connection.endpoint.label
    facts = parse_facts(connection.run(_PROBE).check(f"{label}: probe").stdout)
    needed = ".".join(map(str, OLDEST_PYTHON))
    if facts.target is None or facts.python is None:
        raise InputError(f"{label}: no python3 there", hint=f"install Python {needed} or newer on the gateway")
    if facts.python < OLDEST_PYTHON or facts.implementation != "CPython":
        found = f"{facts.implementation} {'.'.join(map(str, facts.python))}"
        raise InputError(f"{label}: expected CPython {needed} or newer, found {found}")
    return Gateway(facts.target, facts.executable)


def install(
    connection: Connection, gateway: Gateway, release: WorkerRelease, progress: Callable[[UploadProgress], None]
) -> None:
    """Upload and unpack the release, and make it the current one. An interrupted upload is resumed by the next one."""
    label = connection.endpoint.label
    home = connection.run('printf %s "$HOME"').check(f"{label}: find the home directory").stdout
    words = (GATEWAY_ROOT, release.id, gateway.executable, str(_KEPT_RELEASES))
    has_it = connection.run(f'test -d "$HOME/{GATEWAY_ROOT}/releases/{release.id}"').exit_status == 0
    if not has_it:
        connection.run(f'umask 077; mkdir -p "$HOME/{GATEWAY_ROOT}/uploads"').check(f"{label}: make {GATEWAY_ROOT}")
        path = f"{home}/{GATEWAY_ROOT}/uploads/{release.id}.tar.gz"
        upload(connection, release.archive, path, mode=0o600, progress=progress)
    program = f"set -- {' '.join(words)}\n{_INSTALL}"
    connection.run(program, timeout_s=_INSTALL_TIMEOUT_S).check(f"{label}: install meshctl")


def build_release(gateway: Gateway, wheels: Iterable[Path]) -> WorkerRelease:
    """The release for a gateway from the wheels of its requirements. The same input makes the same bytes."""
    members = [TarMember("bin/meshctl", _START.format(python=gateway.executable).encode(), 0o755)]
    for wheel in sorted(wheels, key=lambda path: path.name):
        members += _unpacked(wheel)
    members += _own_files()
    by_name = {member.name: member for member in members}
    return WorkerRelease(gzip.compress(tar_of([], _copied(by_name.values())), _LEVEL, mtime=0))


def _copied(members: Iterable[TarMember]) -> Iterator[tuple]:  # type: ignore[type-arg]
    # names in wheels may be longer than USTAR allows
    for member in members:
        yield member.info, member.content


def _unpacked(wheel: Path) -> Iterator[TarMember]:
    try:
        with zipfile.ZipFile(wheel) as archive:
            for name in archive.namelist():
                parts = PurePosixPath(name).parts
                if name.endswith("/") or ".." in parts or PurePosixPath(name).is_absolute():
                    continue
                if parts[0].endswith(".data"):
                    # scripts and headers are not needed there
                    if len(parts) < 3 or parts[1] not in ("purelib", "platlib"):
                        continue
                    parts = parts[2:]
                yield TarMember("/".join(("lib", *parts)), archive.read(name))
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"{wheel}: not a wheel: {error}", hint="download it again") from error


def _own_files() -> Iterator[TarMember]:
    """This meshctl and its virtual fleet, with the entry points that connect the two."""
    root = Path(__file__).resolve().parent.parent.parent
    for package in _OWN_PACKAGES:
        yield from _tree(root / package, f"lib/{package}")
    for kind in _SHIPPED:
        yield from _tree(shipped(kind), f"lib/meshctl/_shipped/{kind}")
    info = f"lib/meshctl_worker-{__version__}.dist-info"
    lines = [f"{point.name} = {point.value}\n" for point in entry_points(group=_EXTENSIONS)]
    yield TarMember(f"{info}/entry_points.txt", f"[{_EXTENSIONS}]\n{''.join(sorted(lines))}".encode())
    yield TarMember(
        f"{info}/METADATA", f"Metadata-Version: 2.1\nName: meshctl-worker\nVersion: {__version__}\n".encode()
    )


def _tree(folder: Path, name: str) -> Iterator[TarMember]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not {"__pycache__", "_shipped"} & set(path.relative_to(folder).parts):
            mode = 0o755 if path.stat().st_mode & 0o100 else 0o644
            yield TarMember(f"{name}/{path.relative_to(folder).as_posix()}", path.read_bytes(), mode)


def requirements(extra: str = "") -> tuple[str, ...]:
    """The requirements of meshctl in its package's metadata, and those of one of its extras; other extras are for
    operators."""
    found: list[str] = []
    for line in distribution(_DISTRIBUTION).requires or ():
        requirement, _, marker = line.partition(";")
        named = re.search(r"extra == ['\"]([\w-]+)['\"]", marker)
        if named is None:
            found.append(line)
        elif named[1] == extra:
            found.append(re.sub(r"\[[^]]*\]", "", requirement).strip())
    return tuple(found)


def download_wheels(target: Target, directory: Path, named: Path | None, extra: str = "") -> tuple[Path, ...]:
    """The wheels of all requirements for a target, in `directory`: from the directory `named` if given, else with pip
    from its index, once. Raises InputError."""
    directory.mkdir(parents=True, exist_ok=True)
    if named is None and (kept := tuple(directory.glob("*.whl"))):
        return kept
    source = [] if named is None else ["--no-index", "--find-links", str(named)]
    command = [sys.executable, "-P", "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    command += ["--only-binary", ":all:", "--dest", str(directory), *source, *pip_options(target), *requirements(extra)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PIP_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"pip could not collect wheels for {target}: {error}") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "no error message").splitlines()[-1]
        hint = "without internet access, pass --wheels DIR with the wheels of meshctl's requirements"
        raise InputError(f"pip could not collect wheels for {target}: {last}", hint=hint)
    return tuple(directory.glob("*.whl"))
