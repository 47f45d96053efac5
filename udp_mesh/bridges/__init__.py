"""Bridges: processes beside the daemon that carry a middleware's messages over the mesh without parsing them.

Shared and pure: `names`, `types`, `protocol` (messages between bridges), `relay` (routing decisions). `daemon_client`
is the connection to the daemon, `runtime` joins it to the relay. Python 3.8 and the standard library only, for old ROS
interpreters; docs/bridges.md.
"""
