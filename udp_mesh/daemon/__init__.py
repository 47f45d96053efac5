"""The transport as a daemon: configuration -> driver over the core and the links -> local API.

`toml_source` and `configuration` read the file, `driver` moves bytes between sockets and the core, `outbox` stores
messages on disk, `recording` writes events to a file, `api` and `service` answer local clients on a Unix socket,
`metrics` and `sd_notify` report to Prometheus and systemd. `main` runs the daemon; `api_node` runs the same transport
inside another program.
"""
