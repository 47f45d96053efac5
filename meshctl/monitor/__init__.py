"""Watching a fleet over time: snapshot -> frame -> store -> page and metrics.

`sampler` collects a snapshot on a schedule; `frame` makes one JSON document of it; `store` keeps the frames in one
SQLite file, and `alarm_log` the alarms in the same file; `metrics` renders the newest frame for Prometheus; `hooks`
reports new alarms to other programs. docs/monitor.md describes the file, the frame and the metrics.
"""
