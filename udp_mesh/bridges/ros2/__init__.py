"""The ROS 2 bridge on rclpy's raw subscriptions: `python3 -m udp_mesh.bridges.ros2 --socket ...`.

Tested with a real rclpy and Fast DDS (docs/bridges.md). With rmw_zenoh, use the Zenoh bridge instead: it needs no
message packages.
"""
