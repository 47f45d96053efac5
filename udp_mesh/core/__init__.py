"""The transport without I/O: bytes and the time go in; datagrams, events and one timer come out.

`endpoint.Endpoint` is the interface for a driver; `settings`, `events` and `conditions` are its other inputs and
outputs.
"""
