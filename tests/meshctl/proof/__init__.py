"""Proof that no cut strands a node: virtual fleets of real dropbear and ash, meshctl as a process of its own."""
