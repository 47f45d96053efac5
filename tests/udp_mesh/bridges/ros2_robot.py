"""A ROS 2 node that a test drives: requests as JSON lines on standard input, what it receives as JSON lines on standard
output. It runs in the Python that has rclpy (`ros2_processes`), so it imports nothing of ours.

    {"publish": NAME, "data": TEXT, "latched": false}      a std_msgs/String
    {"subscribe": NAME, "latched": false}                  -> {"name": NAME, "data": TEXT} for each message
"""

from __future__ import annotations

import json
import sys
import threading
from queue import Empty, Queue
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String


def profile(request: dict[str, Any]) -> QoSProfile:
    return QoSProfile(
        depth=10,
        reliability=ReliabilityPolicy.BEST_EFFORT if request.get("best_effort") else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if request.get("latched") else DurabilityPolicy.VOLATILE,
    )


def answer(line: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def main() -> None:
    requests: Queue[dict[str, Any] | None] = Queue()

    def read() -> None:
        for line in sys.stdin:
            requests.put(json.loads(line))
        requests.put(None)

    rclpy.init(args=[])
    node = rclpy.create_node(sys.argv[1])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    publishers: dict[str, Any] = {}
    kept: list[Any] = []
    threading.Thread(target=read, daemon=True).start()
    answer({"ready": True})
    while True:
        executor.spin_once(timeout_sec=0.02)
        try:
            request = requests.get_nowait()
        except Empty:
            continue
        if request is None:
            break
        if "publish" in request:
            name = request["publish"]
            if name not in publishers:
                publishers[name] = node.create_publisher(String, name, profile(request))
            publishers[name].publish(String(data=request["data"]))
        else:
            name = request["subscribe"]

            def arrived(message: Any, name: str = name) -> None:
                answer({"name": name, "data": message.data})

            kept.append(node.create_subscription(String, name, arrived, profile(request)))
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
