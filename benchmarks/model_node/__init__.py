"""Model nodes: real dropbear, answers from recordings at a router's pace, almost no processor time of this machine.

`fleet.ModelFleet` runs them, `server` is their process, `node` decides what a command answers and how long it takes.
"""
