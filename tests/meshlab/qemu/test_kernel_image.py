"""The machine starts from the ELF file in Debian's kernel; an image without a usable one stays as it is."""

from __future__ import annotations

import lzma
import struct

import pytest

from meshlab.qemu.kernel_image import uncompressed

PVH_NOTE = struct.pack("<III4s", 4, 8, 18, b"Xen\0")
KERNEL = b"\x7fELF" + bytes(range(256)) * 40 + PVH_NOTE + bytes(8)
SETUP_SECTORS = 4
OFFSET = 37


def bz_image(payload: bytes, content: bytes) -> bytes:
    """As the kernel's build makes it: setup sectors, decompressor, payload with the size of its content."""
    payload += struct.pack("<I", len(content))
    setup = bytearray((SETUP_SECTORS + 1) * 512)
    setup[0x1F1] = SETUP_SECTORS
    setup[0x202:0x206] = b"HdrS"
    struct.pack_into("<II", setup, 0x248, OFFSET, len(payload))
    return bytes(setup) + b"\x90" * OFFSET + payload + b"\xcc" * 99


def test_the_compressed_kernel_of_an_image_is_found() -> None:
    assert uncompressed(bz_image(lzma.compress(KERNEL), KERNEL)) == KERNEL


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(bz_image(lzma.compress(KERNEL[:-12]), KERNEL[:-12]), id="QEMU has no entry"),
        pytest.param(bz_image(lzma.compress(b"MZ" + KERNEL), KERNEL), id="not an ELF file"),
        pytest.param(bz_image(b"\x28\xb5\x2f\xfd" + KERNEL, KERNEL), id="another compression"),
        pytest.param(bz_image(b"\xfd7zXZ\0" + bytes(100), KERNEL), id="damaged"),
        pytest.param(KERNEL, id="an ELF file already"),
        pytest.param(b"", id="empty"),
    ],
)
def test_an_image_without_a_kernel_that_qemu_can_start_stays(image: bytes) -> None:
    assert uncompressed(image) == image
