"""Plans become true here: over SSH, node by node or a whole mesh at one moment, journaled, never stranding a node.

The flow: `access` reaches nodes, `gather` observes the fleet, `planning` makes the plan, `execute` carries it out with
`node` (configuration), `flash` (firmware), `packages` and `switch` (a whole mesh); `checks` decides whether a change
has proven itself. `bootstrap`, `replace`, `keep` and `trusting` are the bench's verbs on the same parts.
"""
