"""Pure parsers, one per tool whose output a node tells; none raises on any text."""
