"""The command `udp-mesh`: parses arguments, sends requests to the daemon, prints the replies.

`main` has the parser and the exit codes, `views` formats replies, `output` writes them. The other modules hold the
commands: `serve` runs the daemon and checks configurations, `inspect` shows state, `change` modifies it, `traffic`
sends, receives and measures.
"""
