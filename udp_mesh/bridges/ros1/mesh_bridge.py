#!/usr/bin/env python3
"""The bridge as roslaunch starts it: finds the package `udp_mesh` this file lies in, wherever it was unpacked.

A robot that ran the fielded system has another package `udp_mesh` on its path, and what lies beside ours (a virtual
environment's packages for another Python) is none of ROS's business. So the package is loaded by its place, and the
path stays as it is.
"""

import importlib.util
import os
import sys

HERE = os.path.dirname(os.path.realpath(__file__))
PACKAGE = os.path.dirname(os.path.dirname(HERE))


def load_package() -> None:
    """Makes `import udp_mesh` mean the package around this file."""
    # A script's own folder comes first, and is none to import from.
    sys.path[:] = [path for path in sys.path if os.path.realpath(path or ".") != HERE]
    start = os.path.join(PACKAGE, "__init__.py")
    spec = importlib.util.spec_from_file_location("udp_mesh", start, submodule_search_locations=[PACKAGE])
    if spec is None or spec.loader is None:
        sys.exit("mesh_bridge.py: expected the package udp_mesh around it, found no {}".format(start))
    module = importlib.util.module_from_spec(spec)
    sys.modules["udp_mesh"] = module
    spec.loader.exec_module(module)


load_package()

from udp_mesh.bridges.ros1.bridge import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
