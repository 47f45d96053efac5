"""Constants shared by the daemon and its command line: paths, reserved topics, limits.

Apart from `configuration`, which imports the transport, so that a command that only talks to the daemon starts fast.
"""

from __future__ import annotations

from pathlib import Path

DEFAULT_PATH = Path("/etc/udp-mesh/udp-mesh.toml")
DEFAULT_SOCKET = Path("/run/udp-mesh/udp-mesh.sock")

RESERVED_PREFIX = "~mesh/"
"""Prefix of the daemon's own topics: ping, pong, benchmark, position."""
POSITION_TOPIC = "~mesh/position"
"""Topic on which each daemon sends its node's position to all."""
METER_TOPIC = "~mesh/meter"
"""Topic of the placement meter's readings for local subscribers; it never leaves the machine."""
PING_TOPIC, PONG_TOPIC, BENCH_TOPIC = "~mesh/ping", "~mesh/pong", "~mesh/bench"
CONDITIONS_TOPIC = "~mesh/conditions"
"""Topic that carries the network conditions to local subscribers; it never leaves the machine."""
MAX_PING_S = 60.0
"""Maximum timeout of a ping."""
