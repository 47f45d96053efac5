"""The transport as a running program: configuration -> driver over the core and the links -> local API.

`toml_source` and `configuration` read the file, `driver` moves bytes between sockets and the core, `outbox` keeps
messages on disk, `recording` writes what happens to a file, `api` and `service` answer local programs on a Unix
socket, `metrics` and `notify` tell Prometheus and systemd, `program` is the whole daemon, `library` the same
transport inside another program.
"""
