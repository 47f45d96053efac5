"""ARP on the channel: `overhear_arp.py SECONDS` captures on hwsim's monitor, which shows every transmission once.

Prints `listening` when the capture has started, then a line `KIND RATE BYTES COUNT` for each kind of packet that has
ARP inside batman-adv (broadcast; unicast: to one node; table: a request to the distributed ARP table, or an entry for
it) and, for comparison, for batman-adv's own (ogm); then `requests N`, the number of distinct broadcasts. Rate in
radiotap's units of 500 kbit/s (0: unknown, an 802.11n rate); bytes: the frame without checksum.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections import Counter

# net/batman-adv: include/uapi/linux/batadv_packet.h
_OGM, _BROADCAST, _UNICAST, _UNICAST_4ADDR = 0x00, 0x01, 0x40, 0x42
# the lengths of their headers, which precede the Ethernet frame
_HEADERS = {_BROADCAST: 14, _UNICAST: 10, _UNICAST_4ADDR: 18}
# subtype of a 4-address packet; 1 is data
_SUBTYPE_AT, _PLAIN_DATA = 16, 1
_ARP = b"\x08\x06"
_ETH_P_ALL = 3
_BATMAN = b"\xaa\xaa\x03\x00\x00\x00\x43\x05"
# hwsim's radiotap header: version, length, present fields, time, flags, then the rate
_RATE_AT = 17


def kind_of(packet: bytes) -> str:
    """The kind of a batman-adv packet; empty for any other packet."""
    kind = packet[0] if packet else -1
    if kind == _OGM:
        return "ogm"
    inner = _HEADERS.get(kind)
    if inner is None or packet[inner + 12 : inner + 14] != _ARP:
        return ""
    if kind == _BROADCAST:
        return "broadcast"
    return "table" if kind == _UNICAST_4ADDR and packet[_SUBTYPE_AT] != _PLAIN_DATA else "unicast"


def main(seconds: float) -> None:
    subprocess.run(["ip", "link", "set", "hwsim0", "up"], check=True)
    found: Counter[tuple[str, int, int]] = Counter()
    requests: set[bytes] = set()
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL)) as air:
        air.bind(("hwsim0", 0))
        sys.stdout.write("listening\n")
        sys.stdout.flush()
        until_s = time.monotonic() + seconds
        while (left_s := until_s - time.monotonic()) > 0:
            air.settimeout(left_s)
            try:
                frame = air.recv(4096)
            except TimeoutError:
                break
            body = frame[int.from_bytes(frame[2:4], "little") :]
            # data frames have a header of 24 bytes, 26 with quality of service
            at = 26 if body[:1] == b"\x88" else 24
            if body[at : at + 8] != _BATMAN:
                continue
            packet = body[at + 8 :]
            kind = kind_of(packet)
            if kind:
                found[kind, frame[_RATE_AT], len(body)] += 1
            if kind == "broadcast":
                # sequence number and originator
                requests.add(packet[4:14])
    subprocess.run(["ip", "link", "set", "hwsim0", "down"], check=True)
    for (kind, rate, length), count in sorted(found.items()):
        sys.stdout.write(f"{kind} {rate} {length} {count}\n")
    sys.stdout.write(f"requests {len(requests)}\n")


if __name__ == "__main__":
    main(float(sys.argv[1]))
