"""What meshctl says: to people on a terminal, to scripts as JSON, to other tools in their formats. Output only."""
