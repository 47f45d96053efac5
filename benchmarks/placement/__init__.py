"""Where to drop beacons: the placement meter against geometric and RSSI rules, in seeded virtual tunnels.

`tunnels` makes the ground, `rules` the other teams' laws, `drive` runs one law through one tunnel in virtual time, and
`__main__` compares them at equal outage.
"""
