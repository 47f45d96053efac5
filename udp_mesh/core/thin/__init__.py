"""Thin links: messages over radios and lines of 1 to 100 kbit/s with small frames, beside the datagrams.

`thin_links` connects them with the node. Below it: `settings`; `airtime` (the duty-cycle budget); `peers` (boots,
proofs that a sender is alive, forgeries); `outgoing` (messages on their way, per link); `link` (frames of one link);
`reassembly` and `copies` (messages in, each once).
"""
