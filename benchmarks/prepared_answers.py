"""What all the radios of `status_fleet` answer, from one process: `python -m benchmarks.prepared_answers DIRECTORY`.

Behind each radio's dropbear, `nc` connects to the radio's own address at `PORT`. Of what meshctl sends, the lines of
`meshctl.device.kept_script` matter, a mark and the nonce; the script before them is not run. Up to 0.6.0 meshctl sent
the script for each look, with the nonce in its first line, and the radio all its originators. The answer is the file of
that address in DIRECTORY, with this nonce, compressed as by gzip on a radio.
"""

from __future__ import annotations

import gzip
import re
import socketserver
import sys
from pathlib import Path

PORT = 7000
_LOOK = re.compile(rb"(ended-[0-9a-f]{32}) (\S+).*\n")
_ONLY_LOOK = re.compile(rb"N=(\S+)\n")


class _Radio(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        address = self.connection.getsockname()[0]
        answers = Path(sys.argv[1])
        for line in self.rfile:
            if look := _LOOK.fullmatch(line):
                mark, nonce = look.groups()
                self.wfile.write(_answer(answers / "near" / address, nonce) + mark + b" 0\n")
            elif look := _ONLY_LOOK.fullmatch(line):
                self.wfile.write(_answer(answers / "all" / address, look[1]))


def _answer(prepared: Path, nonce: bytes) -> bytes:
    packed = gzip.compress(prepared.read_bytes().replace(b"NONCE ", nonce + b" "), compresslevel=1)
    return nonce + b" gzip\n" + packed


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    request_queue_size = 1000


def main() -> None:
    with _Server(("0.0.0.0", PORT), _Radio) as server:
        print(f"listening on {PORT}", flush=True)
        server.serve_forever()


if __name__ == "__main__":
    main()
