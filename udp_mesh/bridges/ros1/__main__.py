"""`python3 -m udp_mesh.bridges.ros1`."""

import sys

from udp_mesh.bridges.ros1.bridge import main

if __name__ == "__main__":
    sys.exit(main())
