"""A virtual fleet on one Linux machine: OpenWrt-like nodes in namespaces, and the links between them.

`spec` describes nodes, links and releases; `fleet.VirtualFleet` starts and stops the fleet; `faults` injects faults.
docs/lab.md explains how it works and how it differs from real radios.
"""
