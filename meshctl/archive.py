"""Deterministic tar archives: members in, the same bytes for the same members out."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterable
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class TarMember:
    """A file; a symbolic link if `link_to` is given; a directory if `is_directory`."""

    name: str
    content: bytes = field(default=b"", repr=False)
    mode: int = 0o644
    link_to: str = ""
    is_directory: bool = False

    @property
    def info(self) -> tarfile.TarInfo:
        """Its header: owned by root, without a time."""
        info = tarfile.TarInfo(self.name)
        info.mode = self.mode
        if self.link_to:
            info.type, info.linkname, info.mode = tarfile.SYMTYPE, self.link_to, 0o777
        elif self.is_directory:
            info.type = tarfile.DIRTYPE
        else:
            info.size = len(self.content)
        return info


def tar_of(members: Iterable[TarMember], copied: Iterable[tuple[tarfile.TarInfo, bytes]] = ()) -> bytes:
    """An uncompressed USTAR archive of the members in the order given.

    `copied` are members of another archive, with their content: they follow with their own owner, time and mode. Their
    names may be longer than USTAR allows, so an archive that has them is in GNU format, as busybox's tar writes it.
    """
    out = io.BytesIO()
    others = list(copied)
    with tarfile.open(fileobj=out, mode="w", format=tarfile.GNU_FORMAT if others else tarfile.USTAR_FORMAT) as tar:
        for info, content in [*((member.info, member.content) for member in members), *others]:
            tar.addfile(info, io.BytesIO(content))
    return out.getvalue()
