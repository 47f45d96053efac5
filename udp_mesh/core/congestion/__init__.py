"""How much may be in flight to one peer: round-trip times in, window and pacing rate out."""
