"""In place of the ROS package tf2_msgs, of which no wheel exists."""
