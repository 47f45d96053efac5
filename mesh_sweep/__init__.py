"""Sweeps: many settings of one scenario, many seeds of each, compared with confidence intervals.

`--set` and `--seeds` -> `cases` -> `dispatch` (which case runs next, and which one kills its workers) -> an executor ->
`results` (JSON lines, keyed by scenario, revision, settings and seed) -> `comparison` -> text, JSON, `page`.

The engine of `udp-mesh sim sweep` and of `meshctl lab sweep`; it imports neither. `run`, `executors`, `results_file`,
`revision` and `command` do the I/O, the other modules are functions of values.
"""
