"""The wire format: header -> sealed frames -> immutable values, and back.

`header` reads and writes the clear bytes in front of a datagram, `frames` defines the values inside it, `codec` and
`fragment` convert between bytes and frames with the bounded reader of `buffer`, `limits` defines every cap, and
`legacy` is the format of older fleets. Nothing here uses a key, a clock or a socket. The format is described in
docs/wire-format.md.
"""
