"""A fleet in one QEMU machine, with the Linux kernel's own radios, mesh and bridges.

`initramfs` builds the machine's root from Debian packages, `qemu` starts the machine. `host_proxy` is the fleet's
process on the host; it talks to `guest_agent` in the machine over `guest_protocol`. `guest_supervisor` is the virtual
fleet's supervisor in the machine, with `link_state` for links, `traffic_control` for losses and `hwsim_devices` for
radios and cables. `meshlab.fleet.QemuFleet` starts and stops it, `control` runs commands in the machine. docs/lab.md
explains how it works and how it differs from real radios.
"""
