"""The command `udp-mesh`: parse, ask the daemon, show, exit.

`main` has the parser and the exit codes, `views` turns replies into text, the other modules hold the commands:
`serve` runs and checks, `inspect` shows, `change` sets, `traffic` sends, receives and measures.
"""
