"""A fleet whose radios, mesh and bridges are the Linux kernel's own, inside one machine that QEMU runs.

`image` assembles the machine's root from Debian packages, `machine` starts it, `relay` is the process behind a running
fleet on this side, `guest` the one on the other side: the virtual fleet's supervisor with `ether` for its air and
`hardware` for its cables and radios. `fleet.RealFleet` brings it up and down, `control` reaches into the machine.
docs/lab.md tells how it works and where it differs from real radios.
"""
