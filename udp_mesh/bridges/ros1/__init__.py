"""The ROS 1 bridge, for ROS's own interpreter: `python3 -m udp_mesh.bridges.ros1`, or `mesh_bridge.py` by roslaunch."""
