"""Telemetry through two udp_mesh daemons: `telemetry.py send SOCKET PERIOD_S` or `telemetry.py record SOCKET FILE`.

The recorder writes one line per message: its arrival on the machine's monotonic clock, which all its network namespaces
share, and its number.
"""

from __future__ import annotations

import itertools
import sys
import time

from udp_mesh.client import MeshClient


def send(socket: str, period_s: float) -> None:
    with MeshClient(socket) as client:
        due_s = time.monotonic()
        for number in itertools.count():
            client.publish("telemetry", str(number).encode(), wait=False)
            due_s += period_s
            time.sleep(max(0.0, due_s - time.monotonic()))


def record(socket: str, path: str) -> None:
    with MeshClient(socket) as client, open(path, "a", buffering=1) as file:
        client.subscribe("telemetry")
        for message in client.messages():
            file.write(f"{time.monotonic():.4f} {message.payload.decode()}\n")


if __name__ == "__main__":
    if sys.argv[1] == "send":
        send(sys.argv[2], float(sys.argv[3]))
    else:
        record(sys.argv[2], sys.argv[3])
