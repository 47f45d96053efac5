"""batman-adv's own packets: `overhear.py SECONDS` captures on hwsim's monitor, which shows every transmission once.

Prints a line `KIND RATE BYTES COUNT` for each kind of packet (ogm, elp, ogm2; probe: an ELP packet to one neighbor):
rate in radiotap's units of 500 kbit/s (0: unknown, an 802.11n rate), length of the frame without checksum.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections import Counter

# net/batman-adv: include/uapi/linux/batadv_packet.h
KINDS = {0x00: "ogm", 0x03: "elp", 0x04: "ogm2"}
_ETH_P_ALL = 3
_BATMAN = b"\xaa\xaa\x03\x00\x00\x00\x43\x05"
# hwsim's radiotap header: version, length, present fields, time, flags, then the rate
_RATE_AT = 17


def main(seconds: float) -> None:
    subprocess.run(["ip", "link", "set", "hwsim0", "up"], check=True)
    found: Counter[tuple[str, int, int]] = Counter()
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL)) as air:
        air.bind(("hwsim0", 0))
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            air.settimeout(left_s)
            try:
                frame = air.recv(4096)
            except TimeoutError:
                break
            header = int.from_bytes(frame[2:4], "little")
            body = frame[header:]
            # data frames have a header of 24 bytes, 26 with quality of service
            at = 26 if body[:1] == b"\x88" else 24
            if body[at : at + 8] == _BATMAN and body[at + 8] in KINDS:
                kind = KINDS[body[at + 8]]
                # the receiver's address: the lowest bit of its first byte is the group bit
                if kind == "elp" and not body[4] & 1:
                    kind = "probe"
                found[kind, frame[_RATE_AT], len(body)] += 1
    subprocess.run(["ip", "link", "set", "hwsim0", "down"], check=True)
    for (kind, rate, length), count in sorted(found.items()):
        sys.stdout.write(f"{kind} {rate} {length} {count}\n")


if __name__ == "__main__":
    main(float(sys.argv[1]))
