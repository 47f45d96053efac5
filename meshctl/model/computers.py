"""Known properties of robots' computers: ROS distributions that the bridges support, and architectures."""

from __future__ import annotations

# the only ROS 1 distribution whose Python the bridge supports
ROS_1 = "noetic"
# the bridge is started by hand (docs/bridges.md)
ROS_2 = ("foxy", "galactic", "humble", "iron", "jazzy", "kilted", "lyrical", "rolling")
# their Python is older than 3.8, which the bridge needs
ROS_TOO_OLD = ("indigo", "jade", "kinetic", "lunar", "melodic")
# output of `uname -m` on platforms with Python wheels
ARCHITECTURES = ("aarch64", "armv6l", "armv7l", "i686", "ppc64le", "riscv64", "s390x", "x86_64")
