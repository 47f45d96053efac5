"""Bridges: processes beside the daemon that carry a middleware's messages over the mesh, unread.

Shared by all: `names`, `types`, `exchange` (what bridges tell each other), `relay` (who gets what), all pure;
`port`, the connection to the daemon. Python 3.8 and the standard library, for old ROS interpreters; docs/bridges.md.
"""
