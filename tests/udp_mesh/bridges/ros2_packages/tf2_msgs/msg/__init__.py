"""rclpy needs a class to carry a topic's bytes, which the bridge and the tests read and write themselves: the class of
another message carries them as well."""

from test_msgs.msg import UnboundedSequences as TFMessage

__all__ = ["TFMessage"]
