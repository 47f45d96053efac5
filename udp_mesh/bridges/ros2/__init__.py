"""The ROS 2 bridge on rclpy's raw subscriptions: `python3 -m udp_mesh.bridges.ros2 --socket ...`.

Written against rclpy's documented interface and not yet run with ROS 2 (docs/bridges.md); its pure part is tested. With
rmw_zenoh, use the Zenoh bridge instead: it needs no message packages.
"""
