"""Placing radio beacons: how far the link behind a robot still carries, and where the next beacons belong.

`path_loss` and `ground` describe a place, `margin` and `meter` judge the measured links of a robot that drives through
it, `planner` computes the beacons of a route in advance. All of it is pure, except the readers of map files.
"""
