"""Topics that carry versions of one thing: a message is sent as the difference to a version that its peer has.

Sending, in order: `outgoing` (one message for one peer), `sent` (which versions peers have, what is yet to be encoded),
`encoding` (a version and its base -> the body). Receiving: `decoding` (the body -> the version, its hash checked),
`held` (the versions that later differences may refer to). `conditions` counts what was saved. The bytes are in
`udp_mesh.wire.version`.
"""
