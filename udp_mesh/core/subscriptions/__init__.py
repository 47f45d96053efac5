"""Subscriptions: a node sends its peers only the topics that their programs read, no faster than requested.

1. `own`: what the programs here read, for the peers that asked for it.
2. `table`: what the programs of one peer read, as it answered.
3. `selection`: decides for each message whether, when and how old it may be sent.

`core.selective_sending` connects them with the node.
"""
