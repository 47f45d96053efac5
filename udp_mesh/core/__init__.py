"""The transport without I/O: bytes and the time go in, datagrams, events and one timer come out.

`node.Node` is the whole of it for a driver; `settings`, `events` and `conditions` are what goes in and out besides
bytes.
"""
