"""The machine's image: Debian's kernel, decompressed, and an initramfs in two parts.

`base_image` (cached; rebuilt when its recipe changes): packages, kernel modules, compiled Python.
`build_initrd` (at every start, under a second of CPU): the base, the nodes' ROM, this package's code, the fleet's spec.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import inspect
import os
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import meshctl
from meshlab import rootfs
from meshlab.errors import LabError
from meshlab.qemu import apt, cpio, kernel_image, kernel_modules

_HERE = Path(__file__).resolve().parent
_PACKAGE = Path(meshctl.__file__).resolve().parent
# the parts of meshctl that run in the machine
_CODE = ("__init__.py", "diagnostics.py", "errors.py", "model")
CODE_FOLDER = "opt/lab"
FLEET_FOLDER = "lab"
# Debian's programs that the nodes' stand-ins run on real devices
_NODE_PROGRAMS = ("iw", "batctl", "ip", "wpa_supplicant", "iperf3", "nft", "tcpdump")
_PROGRAM_FOLDERS = ("usr/sbin", "sbin", "usr/bin", "bin")
_LIBRARY_FOLDERS = ("lib/x86_64-linux-gnu", "usr/lib/x86_64-linux-gnu", "lib64")
_FOLDERS = ("proc", "sys", "dev", "run", "tmp", "mnt", "root", "etc", "sbin", "bin", FLEET_FOLDER)


@dataclass(frozen=True, slots=True)
class BaseImage:
    """The cached part: `archive` has the files below `root`."""

    kernel: Path
    archive: Path
    root: Path


def cache_folder(environ: Mapping[str, str] = os.environ) -> Path:
    """$XDG_CACHE_HOME/meshctl/lab-real."""
    return Path(environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "meshctl" / "lab-real"


def base_image(cache: Path) -> BaseImage:
    """The base, built if `cache` does not have it. Raises LabError when it cannot be built on this host."""
    if platform.machine() != "x86_64":
        raise LabError(
            f"--real needs an x86_64 host, found {platform.machine()}", hint="run `meshctl lab up` without --real"
        )
    cache.mkdir(parents=True, exist_ok=True)
    place = cache / _recipe_digest()
    with _locked(cache):
        if not place.exists():
            _build_base(cache, place)
    return BaseImage(place / "kernel", place / "base.cpio", place / "root")


def build_initrd(image: BaseImage, spec_text: str, token: str, work: Path) -> Path:
    """Write the initramfs to a file in `work`: the base's archive followed by the files of this fleet."""
    tree = work / "product"
    shutil.rmtree(tree, ignore_errors=True)
    _install_code(tree / CODE_FOLDER)
    _compile(image.root, tree / CODE_FOLDER)
    fleet = tree / FLEET_FOLDER
    fleet.mkdir()
    rootfs.build(fleet / "rom", sysroot=image.root, more=_HERE / "node_root", library_folders=_LIBRARY_FOLDERS)
    _install_programs(image.root, fleet / "rom")
    (fleet / "spec.json").write_text(spec_text, encoding="utf-8")
    (fleet / "token").write_text(token, encoding="ascii")
    shutil.copy2(_HERE / "machine_root" / "init", tree / "init")
    (tree / "init").chmod(0o755)
    initrd = work / "initrd"
    with initrd.open("wb") as out:
        with image.archive.open("rb") as first:
            shutil.copyfileobj(first, out, 1 << 20)
        cpio.write(tree, out)
    shutil.rmtree(tree)
    return initrd


def _recipe_digest() -> str:
    """The cache key of a base: a digest of the code that builds it."""
    sources = [inspect.getsource(module) for module in (apt, kernel_image, kernel_modules, cpio)]
    text = "".join([*sources, inspect.getsource(_build_base)])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _build_base(cache: Path, place: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="building-", dir=cache) as folder:
        work = Path(folder)
        tools = apt.Apt(work, apt.sources(cache))
        apt.update(tools)
        resolved = apt.resolve(tools)
        apt.download(resolved, tools, cache / "archives")
        apt.unpack(resolved, cache / "archives", work / "root")
        apt.unpack_kernel(resolved, cache / "archives", work / "kernel")
        root, made = work / "root", work / "made"
        made.mkdir()
        _install_modules(next((work / "kernel" / "lib" / "modules").iterdir()), root)
        _make_folders(root)
        _compile(root, next((root / "usr" / "lib").glob("python3.*")))
        _compile(root, root / "usr" / "lib" / "python3" / "dist-packages")
        image = next((work / "kernel" / "boot").glob("vmlinuz-*")).read_bytes()
        (made / "kernel").write_bytes(kernel_image.uncompressed(image))
        with (made / "base.cpio").open("wb") as out:
            cpio.write(root, out)
        root.rename(made / "root")
        made.rename(place)


def _install_modules(modules: Path, root: Path) -> None:
    target = root / "lib" / "modules"
    target.mkdir(parents=True, exist_ok=True)
    names = []
    for path in kernel_modules.in_order(modules):
        shutil.copy2(path, target / path.name)
        names.append(path.name)
    (target / "order").write_text("".join(f"{name}\n" for name in names), encoding="ascii")


def _make_folders(root: Path) -> None:
    for folder in _FOLDERS:
        (root / folder).mkdir(parents=True, exist_ok=True)
    for name, content in (("passwd", "root::0:0:root:/root:/bin/sh\n"), ("group", "root:x:0:\n")):
        (root / "etc" / name).write_text(content, encoding="ascii")
    firmware = root / "lib" / "firmware"
    for name in ("regulatory.db", "regulatory.db.p7s"):
        if not (firmware / name).exists():
            (firmware / name).unlink(missing_ok=True)
            (firmware / name).symlink_to(f"{name}-debian")
    # dash: busybox's shell prefers its applets over iproute2
    (root / "bin" / "sh").unlink(missing_ok=True)
    (root / "bin" / "sh").symlink_to("dash")
    if not (root / "bin" / "busybox").exists():
        (root / "bin" / "busybox").symlink_to("../usr/bin/busybox")


def _install_code(target: Path) -> None:
    package = target / "meshctl"
    package.mkdir(parents=True)
    ignored = shutil.ignore_patterns("__pycache__", "node_root", "machine_root")
    shutil.copytree(_HERE.parent, target / "meshlab", ignore=ignored)
    for name in _CODE:
        source = _PACKAGE / name
        if source.is_dir():
            shutil.copytree(source, package / name, ignore=ignored)
        else:
            shutil.copy2(source, package / name)


def _install_programs(root: Path, rom_folder: Path) -> None:
    """Copy Debian's programs for the nodes, and the libraries of these and of the ROM's programs."""
    kernel = rom_folder / "lab" / "kernel"
    kernel.mkdir(exist_ok=True)
    for name in _NODE_PROGRAMS:
        shutil.copy2(_program(root, name), kernel / name)
    programs = [kernel / name for name in _NODE_PROGRAMS]
    programs += [rom_folder / "lab" / name for name in ("dropbear", "dropbearkey")]
    for library in {path for program in programs for path in _libraries(root, program)}:
        target = rom_folder / library.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(library.resolve(), target)


def _libraries(root: Path, program: Path) -> list[Path]:
    """The program's libraries in `root`, and the loader."""
    loader = _loader(root)
    listed = subprocess.run((*loader, "--list", program), capture_output=True, text=True, check=False).stdout
    return [Path(path) for path in re.findall(r"=> (/\S+) \(0x", listed)] + [Path(loader[0])]


def _program(root: Path, name: str) -> Path:
    found = next((root / folder / name for folder in _PROGRAM_FOLDERS if (root / folder / name).is_file()), None)
    if found is None:
        raise LabError(f"no package of the lab's machine contains {name}")
    return found


def _compile(root: Path, folder: Path) -> None:
    """Compile Python files with the machine's Python on the host: under emulation it would take most of the start."""
    python = sorted((root / "usr" / "bin").glob("python3.*"))[0]
    options = ("-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash", folder)
    environment = {"PYTHONHOME": str(root / "usr"), "PATH": "/usr/bin:/bin"}
    words = (*_loader(root), python, *options)
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LabError(f"cannot compile the Python files in {folder}: {done.stderr.strip() or done.stdout.strip()}")


def _loader(root: Path) -> tuple[str, str, str]:
    """The command prefix that runs a program of `root` on the host with the libraries of `root`."""
    libraries = ":".join(str(root / name) for name in _LIBRARY_FOLDERS)
    return str(root / "lib64" / "ld-linux-x86-64.so.2"), "--library-path", libraries


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
