"""udp_mesh moves prioritized messages between robots over nothing but unicast and broadcast UDP.

The flow: bytes -> frame -> session -> scheduler -> message (docs/design.md, docs/wire-format.md).
"""

__version__ = "0.1.0"
