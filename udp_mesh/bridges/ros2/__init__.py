"""The ROS 2 bridge on rclpy's raw subscriptions: `python3 -m udp_mesh.bridges.ros2 --topic /chatter ...`.

Written against rclpy's documented interface and not yet run against a ROS 2 (docs/bridges.md); its pure part is tested.
Where ROS 2 runs on rmw_zenoh, the Zenoh bridge does the same without message packages.
"""
