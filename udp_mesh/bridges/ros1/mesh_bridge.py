#!/usr/bin/env python3
"""Entry point for roslaunch: loads the package `udp_mesh` that contains this file, wherever it was unpacked.

A robot that ran the legacy system has another package `udp_mesh` on its path, and the directory beside ours (such as a
virtual environment for another Python) must not be visible to ROS. The package is therefore loaded by its location, and
the path is not changed.
"""

import importlib.util
import os
import sys

HERE = os.path.dirname(os.path.realpath(__file__))
PACKAGE = os.path.dirname(os.path.dirname(HERE))


def load_package() -> None:
    """Makes `import udp_mesh` load the package that contains this file."""
    # Python puts the script's directory first on the path; nothing may be imported from it.
    sys.path[:] = [path for path in sys.path if os.path.realpath(path or ".") != HERE]
    start = os.path.join(PACKAGE, "__init__.py")
    spec = importlib.util.spec_from_file_location("udp_mesh", start, submodule_search_locations=[PACKAGE])
    if spec is None or spec.loader is None:
        sys.exit("mesh_bridge.py: not inside the package udp_mesh: {} does not exist".format(start))
    module = importlib.util.module_from_spec(spec)
    sys.modules["udp_mesh"] = module
    spec.loader.exec_module(module)


load_package()

from udp_mesh.bridges.ros1.bridge import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
