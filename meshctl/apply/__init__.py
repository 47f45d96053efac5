"""Change nodes over SSH, one by one or a whole mesh at once; what is not confirmed rolls back.

`prepare` makes the plan from the inventory and the observed fleet. `executor` runs it with `commit_confirm`
(configuration), `sysupgrade` (firmware), `packages` and `mesh_commit` (a whole mesh), and journals every step.
`health_checks` decides whether a change is confirmed. `bootstrap`, `replace` and `backup` use the same parts.
"""
