"""Output: text for terminals, JSON for scripts, and the formats of other tools."""
