"""Pure parsers, one for each tool on a node; none raises on any input."""
