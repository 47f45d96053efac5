"""Congestion control per peer: round-trip times in, congestion window and pacing rate out."""
