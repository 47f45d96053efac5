"""A virtual fleet on one Linux machine: OpenWrt-like nodes in namespaces, and the air between them.

`spec` says what there is (nodes, links, releases), `fleet.VirtualFleet` brings it up and down, `breaks` hurts it.
docs/lab.md tells how it works and where it differs from real radios.
"""
