"""The kernel as an ELF file, which QEMU starts without the kernel's own decompression, slow under emulation."""

from __future__ import annotations

import lzma
import struct

# Linux Documentation/arch/x86/boot.rst: fields of a bzImage's setup header
_MAGIC_AT = 0x202
_MAGIC = b"HdrS"
_SETUP_SECTORS_AT = 0x1F1
_PAYLOAD_AT = 0x248
_SECTOR_BYTES = 512
_XZ = b"\xfd7zXZ\0"
_ELF = b"\x7fELF"
# the note of the entry at which QEMU starts (PVH), XEN_ELFNOTE_PHYS32_ENTRY: sizes of its name and content, type, name
_PVH_NOTE = struct.pack("<III4s", 4, 8, 18, b"Xen\0")


def uncompressed(image: bytes) -> bytes:
    """The ELF file in a bzImage; the image itself unless it holds one that QEMU can start, compressed as Debian's."""
    if image[_MAGIC_AT : _MAGIC_AT + len(_MAGIC)] != _MAGIC:
        return image
    offset, length = struct.unpack_from("<II", image, _PAYLOAD_AT)
    start = (image[_SETUP_SECTORS_AT] + 1) * _SECTOR_BYTES + offset
    payload = image[start : start + length]
    if not payload.startswith(_XZ):
        return image
    try:
        # what follows is the size of the content
        kernel = lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(payload)
    except lzma.LZMAError:
        return image
    return kernel if kernel.startswith(_ELF) and _PVH_NOTE in kernel else image
