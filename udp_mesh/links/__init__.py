"""UDP sockets on the kernel's interfaces: interfaces -> attachments -> sockets.

`netlink` lists interfaces and addresses and reports changes, `attachments` selects those that match the configuration,
`udp` is one socket per attachment, `hub` opens and closes sockets to match the selected attachments.
"""
