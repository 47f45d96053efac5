#!/usr/bin/env python3
"""The bridge as roslaunch starts it: finds the package `udp_mesh` this file lies in, wherever it was unpacked."""

import os
import sys

# At the end: nothing that lies beside it may hide what belongs to ROS's interpreter.
sys.path.append(os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__))))))
# A script's own folder comes first, and is none to import from.
sys.path[:] = [
    path for path in sys.path if os.path.realpath(path or ".") != os.path.dirname(os.path.realpath(__file__))
]

from udp_mesh.bridges.ros1.bridge import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
