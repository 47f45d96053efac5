"""An exploration mission over udp_mesh and over the legacy transport, with ROS masters (docs/benchmarks.md)."""
