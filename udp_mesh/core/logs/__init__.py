"""Shared logs: items that reach their readers through any node that meets both sides.

A topic with a `Log` is a log. Each source numbers its items; nodes announce which items they hold (`messages`),
request what they lack from anyone who has it, and keep it on disk within the topic's retention. In this order:

1. `replicator.Replicator.append` signs and stores an item (`item`) and announces it once it is on disk.
2. `knowledge` holds what every peer has, as ranges; `pulling` chooses what to request from whom.
3. A holder reads requested items from its store and sends them as messages of the topic's priority.
4. The receiver verifies and stores an item, announces it, and delivers it once if it is a reader.
5. `retention` chooses what to drop when the log is full or items are too old.
"""
