"""The read-only root file system that all nodes of a fleet share: busybox, dropbear, their libraries, the stand-ins.

find the programs -> copy them -> remove applets that OpenWrt's busybox does not have -> check the shell

Debian's busybox is a "standalone shell": its ash runs its own applets before it searches PATH, so a stand-in for
`sync`, `reboot` or `logread` would never run. OpenWrt's is not. Applet names are in one sorted table of the program;
in the fleet's copies the unwanted names are overwritten in place, keeping the order.

In busybox 1.38.0, a shell that has caught a signal hangs in its next `read` (reported as openwrt/openwrt#23745). Where
the host's does, dash runs process 1, which alone catches signals.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path

from meshlab.errors import LabError

STAND_INS = Path(__file__).resolve().parent / "node_root"
INIT_SHELL = "/rom/lab/init-shell"
"""What runs process 1 of a node, where its own shell cannot; it need not exist."""

# applets that stand-ins replace: the fleet's busybox must not have these names
_REPLACED = frozenset({"date", "sync", "fsync", "reboot", "poweroff", "halt", "logread", "logger", "sh", "ash"})
# programs that the stand-ins' own shell finds in PATH: the shell of scripts, and those of a machine (lab/kernel)
_NOT_QUICK = frozenset({"sh", "ip", "ping", "ping6"})
_APPLETS = STAND_INS / "lab" / "applets"
_SEARCH_PATHS = ("/usr/local/sbin", "/usr/local/bin", "/usr/sbin", "/usr/bin", "/sbin", "/bin")


def build(
    rom: Path, *, sysroot: Path | None = None, more: Path | None = None, library_folders: Sequence[str] = ()
) -> None:
    """Build the ROM in the new directory `rom`. Raises LabError that names a missing package.

    `sysroot`: copy the programs from another root of this architecture; the caller then copies the libraries into
    `library_folders`. `more`: a directory of files that replace or extend the stand-ins.
    """
    busybox = find_program("busybox", "busybox-static", sysroot=sysroot)
    dropbear = find_program("dropbear", "dropbear-bin", sysroot=sysroot)
    dropbearkey = find_program("dropbearkey", "dropbear-bin", sysroot=sysroot)
    copied = {"dropbear": dropbear, "dropbearkey": dropbearkey}
    if hangs_in_read(busybox):
        copied[Path(INIT_SHELL).name] = find_program("dash", "dash", sysroot=sysroot)
    shutil.copytree(STAND_INS, rom, ignore=shutil.ignore_patterns("__pycache__"))
    if more is not None:
        shutil.copytree(more, rom, dirs_exist_ok=True)
    for folder in ("bin", "sbin", "usr/bin", "usr/sbin", "lab", "lib"):
        (rom / folder).mkdir(parents=True, exist_ok=True)
    for script in (path for path in rom.rglob("*") if path.is_file()):
        # a wheel does not keep the executable bit
        script.chmod(0o755 if script.read_bytes().startswith(b"#!") else 0o644)
    for name, program in copied.items():
        shutil.copy2(program, rom / "lab" / name)
    if sysroot is None:
        _copy_libraries((busybox, *copied.values()), rom)
    else:
        _note_library_folders(library_folders, rom)
    _install_busybox(busybox, rom)


def find_program(name: str, package: str, *, sysroot: Path | None = None) -> Path:
    """The program's path. Raises LabError that names the Debian package when it is not installed (in `sysroot`)."""
    places = ":".join(f"{sysroot or ''}{folder}" for folder in _SEARCH_PATHS)
    found = (None if sysroot else shutil.which(name)) or shutil.which(name, path=places)
    if found is None:
        raise LabError(f"the virtual fleet needs {name}, which is not installed", hint=f"run `apt install {package}`")
    return Path(found).resolve()


def library_paths(program: Path) -> tuple[str, ...]:
    """The absolute paths of the shared libraries and the loader of `program`; empty for a static one."""
    listed = subprocess.run(["ldd", str(program)], capture_output=True, text=True, check=False)
    paths = re.findall(r"(?:=> |^\s*)(/\S+) \(0x", listed.stdout, re.MULTILINE)
    return tuple(dict.fromkeys(paths))


def library_folders(rom: Path) -> tuple[str, ...]:
    """The library folders in the ROM, relative to its root, as `build` recorded them."""
    return tuple((rom / "lab" / "library_folders").read_text(encoding="utf-8").split())


def _copy_libraries(programs: Sequence[Path], rom: Path) -> None:
    folders = set()
    for path in {path for program in programs for path in library_paths(program)}:
        target = rom / path.lstrip("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(Path(path).resolve(), target)
        folders.add(str(Path(path).parent).lstrip("/"))
    _note_library_folders(folders, rom)


def _note_library_folders(folders: Iterable[str], rom: Path) -> None:
    (rom / "lab" / "library_folders").write_text("\n".join(sorted(folders)) + "\n", encoding="utf-8")


def _install_busybox(busybox: Path, rom: Path) -> None:
    image = busybox.read_bytes()
    names = subprocess.run([str(busybox), "--list"], capture_output=True, text=True, check=True).stdout.split()
    # each is called busybox: only under that name does it take the applet from its first argument
    uses = ("shell", "tools", "genuine", "quick")
    shell, tools, genuine, quick = (rom / "lab" / use / "busybox" for use in uses)
    for program in (shell, tools, genuine, quick):
        program.parent.mkdir()
    # used by the stand-ins
    shutil.copy2(busybox, genuine)
    applets = _applets()
    folders = ("bin", "sbin", "usr/bin", "usr/sbin")
    replaced = {name for name in applets if any((rom / folder / name).exists() for folder in folders)}
    if _is_standalone(busybox):
        shell.write_bytes(without_applets(image, names, set(names) - {"ash", "sh"}, keep=("ash", "sh")))
        keep = tuple(name for name in applets if name not in _REPLACED)
        tools.write_bytes(without_applets(image, names, _REPLACED, keep=keep))
        # runs the stand-ins: with its own applets it need not start a program for each `mv`
        keep = ("ash", *(name for name in applets if name not in _REPLACED | _NOT_QUICK | replaced))
        quick.write_bytes(without_applets(image, names, set(names) - set(keep), keep=keep))
    else:
        shutil.copy2(busybox, shell)
        shutil.copy2(busybox, tools)
        shutil.copy2(busybox, quick)
    for program in (shell, tools, quick):
        program.chmod(0o755)
    if _is_standalone(shell):
        raise LabError(
            f"the shell of {busybox} runs its own applets before it searches PATH",
            hint="run `apt install busybox-static`",
        )
    present = set(names)
    for name in applets:
        use = "shell" if name in ("sh", "ash") else "tools"
        link = rom / "bin" / name
        if name in present and not link.exists() and not any((rom / d / name).exists() for d in ("sbin", "usr/sbin")):
            link.symlink_to(f"/rom/lab/{use}/busybox")
    (rom / "bin" / "busybox").symlink_to("/rom/lab/tools/busybox")


def _applets() -> list[str]:
    lines = _APPLETS.read_text(encoding="utf-8").splitlines()
    return [name for line in lines if not line.startswith("#") for name in line.split()]


def _is_standalone(shell: Path) -> bool:
    """Whether this busybox's ash finds `cat` with an empty PATH."""
    found = subprocess.run(
        [str(shell), "ash", "-c", "PATH=/nonexistent; cat /dev/null"], capture_output=True, check=False
    )
    return found.returncode == 0


def hangs_in_read(busybox: Path) -> bool:
    """Whether its ash hangs in a `read` once it has caught a signal. It uses the processor then, of which it gets one
    second."""
    script = "ulimit -t 1; trap : USR1; kill -USR1 $$; read -r line </proc/version"
    return subprocess.run([str(busybox), "ash", "-c", script], capture_output=True, check=False).returncode != 0


def without_applets(image: bytes, names: Sequence[str], hidden: Iterable[str], *, keep: Sequence[str]) -> bytes:
    """The busybox `image` with the applets `hidden` renamed, so that no lookup finds them.

    Lookups are a binary search in the table of `names`, so a new name must sort like the old one relative to every
    name in `keep`. Raises LabError when the image does not contain the table that `busybox --list` prints.
    """
    table = b"\0".join(name.encode() for name in names) + b"\0"
    start = image.find(table)
    if start < 0:
        raise LabError(
            "the table of applet names was not found in this busybox", hint="run `apt install busybox-static`"
        )
    hidden = set(hidden)
    renamed = b"".join((_renamed(name, keep) if name in hidden else name.encode()) + b"\0" for name in names)
    return image[:start] + renamed + image[start + len(table) :]


def _renamed(name: str, keep: Sequence[str]) -> bytes:
    own = name.encode()
    for ending in (1, 127, own[-1] - 1, own[-1] + 1):
        new = own[:-1] + bytes((ending,))
        if all(new != other.encode() and (new < other.encode()) == (name < other) for other in keep):
            return new
    # a one-letter name (`[`, `w`) may not fit; ash has `[` built in, and `w` is not used
    return own
