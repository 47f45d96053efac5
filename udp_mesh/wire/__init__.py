"""The bytes on the air: header -> sealed frames -> frozen values, and back.

`header` reads and writes the few clear bytes in front of a datagram, `frames` are the values inside it, `codec` turns
the one into the other through the bounded reader of `buffer`, `limits` names every cap, `legacy` is the fielded
format of older fleets. Nothing here knows a key, a clock or a socket. The format is described in docs/wire-format.md.
"""
