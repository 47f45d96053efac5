"""The command line: parse, call, report, exit. Each command's module is imported only when that command is used."""
