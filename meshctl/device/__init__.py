"""One node over SSH: connect, trust, upload, observe, and change it without ever losing it.

`ssh.connect` gives a `Connection`; `trust` decides which host key is believed; `upload` brings files there and proves
it; `observe` reads everything in one round trip; `deadman` stages, arms, applies and confirms a change that undoes
itself; `openwrt` holds the other verbs (sysupgrade, packages, reboot, reload).
"""
