"""The transport as a running program: configuration -> driver over the core and the links -> local API.

`toml_source` and `configuration` read the file, `driver` moves bytes between sockets and the core, `outbox` keeps
messages on disk, `recording` writes what happens to a file, `api` and `service` answer local programs on a Unix
socket, `metrics` and `sd_notify` tell Prometheus and systemd, `main` is the whole daemon, `api_node` the same
transport inside another program.
"""
