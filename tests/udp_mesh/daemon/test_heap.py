"""A daemon does not keep the memory of the largest message that it ever passed on."""

import subprocess
import sys

PROGRAM = """
import pathlib
from udp_mesh.daemon.heap import map_large_blocks

def heap_bytes():
    for line in pathlib.Path("/proc/self/maps").read_text().splitlines():
        if line.endswith("[heap]"):
            start, end = line.split()[0].split("-")
            return int(end, 16) - int(start, 16)
    return 0

map_large_blocks()
block = bytearray(8 << 20)
del block
before = heap_bytes()
block = bytearray(8 << 20)
print(heap_bytes() - before)
"""


def test_a_large_block_is_not_taken_from_the_heap() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True)
    assert int(done.stdout) < 1 << 20
