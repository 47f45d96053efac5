"""Keys and sealing: fleet key -> channel key -> sealed datagram -> opened frames, each packet once.

`keys` holds the fleet's one or two live keys, `channel` seals and opens the datagrams of one direction between two
boots (or of one boot to all), `replay` remembers which packet numbers were seen. docs/threat-model.md says against
whom.
"""
