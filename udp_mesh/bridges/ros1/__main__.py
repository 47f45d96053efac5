"""`python3 -m udp_mesh.bridges.ros1`."""

import sys

try:
    from udp_mesh.bridges.ros1.bridge import main
except ModuleNotFoundError as error:
    raise SystemExit("udp_mesh.bridges.ros1: {} (source /opt/ros/RELEASE/setup.bash first)".format(error)) from error

if __name__ == "__main__":
    sys.exit(main())
