"""What robots' computers may be: the releases of ROS that the bridges know, and kernels' names of processors."""

from __future__ import annotations

# the one release of ROS 1 with a Python that the bridge runs in
ROS_1 = "noetic"
# with these a bridge is started by hand (docs/bridges.md)
ROS_2 = ("foxy", "galactic", "humble", "iron", "jazzy", "kilted", "lyrical", "rolling")
# their Python is older than 3.8, which the bridge needs
ROS_TOO_OLD = ("indigo", "jade", "kinetic", "lunar", "melodic")
# what `uname -m` prints on machines that Python's wheels are built for
ARCHITECTURES = ("aarch64", "armv6l", "armv7l", "i686", "ppc64le", "riscv64", "s390x", "x86_64")
