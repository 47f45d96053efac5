"""Where datagrams enter and leave: the kernel's interfaces -> attachments -> UDP sockets.

`netlink` asks the kernel which interfaces and addresses exist and hears of changes, `attachments` chooses from them
what the operator wished for, `udp` is one socket per attachment, `hub` keeps the open sockets equal to the chosen
attachments.
"""
