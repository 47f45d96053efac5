"""Write a directory as a cpio archive for the kernel (newc), everything owned by root. Archives can be concatenated.

Format: the kernel's Documentation/driver-api/early-userspace/buffer-format.rst.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

_ALIGNMENT = 4
# the next archive must start at a multiple of this
_BLOCK = 512


def write(root: Path, out: BinaryIO) -> None:
    """Append everything below `root`. Hard links become separate files."""
    number = 0
    for folder, folders, files in os.walk(root):
        folders.sort()
        for name in sorted([*folders, *files]):
            path = Path(folder) / name
            number += 1
            _entry(out, number, str(path.relative_to(root)), path)
    _header(out, 0, "TRAILER!!!", mode=0, mtime=0, size=0)
    out.write(bytes(-out.tell() % _BLOCK))


def _entry(out: BinaryIO, number: int, name: str, path: Path) -> None:
    status = path.lstat()
    if stat.S_ISLNK(status.st_mode):
        content = os.readlink(path).encode()
    elif stat.S_ISREG(status.st_mode):
        content = path.read_bytes()
    else:
        content = b""
    _header(out, number, name, mode=status.st_mode, mtime=int(status.st_mtime), size=len(content))
    out.write(content)
    out.write(bytes(-out.tell() % _ALIGNMENT))


def _header(out: BinaryIO, number: int, name: str, *, mode: int, mtime: int, size: int) -> None:
    encoded = name.encode() + b"\0"
    # ino mode uid gid nlink mtime size, four device numbers, the name's length, no checksum
    fields = (number, mode, 0, 0, 1, mtime, size, 0, 0, 0, 0, len(encoded), 0)
    out.write(b"070701" + b"".join(b"%08x" % field for field in fields) + encoded)
    out.write(bytes(-out.tell() % _ALIGNMENT))
