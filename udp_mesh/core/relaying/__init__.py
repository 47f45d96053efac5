"""Relays: sealed datagrams between two nodes that do not hear each other, passed on by those between them.

To the rest of the core a node behind a relay is a peer on the link `RELAY_LINK`, at an address made of its boot id. All
that happens between the two ends (discovery, verification, acknowledgments, congestion control, path MTU, outcomes)
is as over any link. Beneath, hop by hop:

- `neighbors`: relay hellos tell who hears whom, how well, and whom a relay reaches. `hop_channel` seals what two
  neighbors tell each other.
- `routes` chooses the next hop to each node, free of loops.
- `hop_queue` holds what waits for a next hop, most urgent first, bounded per origin; `hop_window` limits what is on its
  way there.
- `relaying` connects these with the node.
"""
