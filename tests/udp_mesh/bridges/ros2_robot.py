"""A ROS 2 node that a test drives: requests as JSON lines on standard input, what it receives as JSON lines on standard
output. It runs in the Python that has rclpy (`ros2_processes`), so it imports nothing of ours.

    {"publish": NAME, "data": TEXT, "latched": false}      a std_msgs/String
    {"subscribe": NAME, "latched": false}                  -> {"name": NAME, "data": TEXT} for each message
    {"serve": NAME, "mute": false}                         a std_srvs/Trigger; mute: it never responds
    {"call": NAME}                                         -> {"answer": NAME, "success": BOOL, "message": TEXT}
    {"serve_action": NAME, "pause_s": SECONDS}             a Fibonacci action, a pause between its numbers
    {"goal": NAME, "order": N}                             -> accepted, feedback, {"result": NAME, "sequence", "status"}
    {"cancel": NAME}                                       -> {"canceling": how many goals}
    {"is_available": NAME}                                 -> {"available": BOOL}, of the Trigger or action

`type` and `fields` may stand beside `publish`, `type` beside `subscribe`: then `data` is the message as YAML, not text.
With `parsed` beside `subscribe`, `data` is how Python shows the message. A message with "depth" has a history of that
many.
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
import threading
import time
from collections.abc import Callable
from queue import Empty, Queue
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci

writing = threading.Lock()


def profile(request: dict[str, Any]) -> QoSProfile:
    return QoSProfile(
        depth=request.get("depth", 10),
        reliability=ReliabilityPolicy.BEST_EFFORT if request.get("best_effort") else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if request.get("latched") else DurabilityPolicy.VOLATILE,
    )


def answer(**line: Any) -> None:
    with writing:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def message_class(request: dict[str, Any]) -> Any:
    package, kind, name = request.get("type", "std_msgs/msg/String").split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


class Robot:
    """The node and everything that was asked for."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.publishers: dict[str, Any] = {}
        self.kept: list[Any] = []
        self.callers: dict[str, Any] = {}
        self.actions: dict[str, Any] = {}
        self.goals: dict[str, Any] = {}
        self.group = ReentrantCallbackGroup()
        self.waiting: list[Callable[[], bool]] = []

    def publish(self, request: dict[str, Any]) -> None:
        name = request["publish"]
        if name not in self.publishers:
            self.publishers[name] = self.node.create_publisher(message_class(request), name, profile(request))
        message = message_class(request)()
        if isinstance(request["data"], str):
            message.data = request["data"]
            self.publishers[name].publish(message)
        else:
            self.publishers[name].publish(bytes.fromhex(request["data"]["cdr"]))

    def subscribe(self, request: dict[str, Any]) -> None:
        name, parsed = request["subscribe"], bool(request.get("parsed"))
        raw = "type" in request and not parsed

        def arrived(message: Any) -> None:
            answer(name=name, data=bytes(message).hex() if raw else repr(message) if parsed else message.data)

        made = self.node.create_subscription(message_class(request), name, arrived, profile(request), raw=raw)
        self.kept.append(made)

    def serve(self, request: dict[str, Any]) -> None:
        name = request["serve"]

        def served(_request: Any, response: Any) -> Any:
            answer(served=name)
            response.success, response.message = True, "done"
            return response

        service = self.node.create_service(Trigger, name, served)
        if request.get("mute"):
            service.send_response = lambda *_: None
        self.kept.append(service)

    def call(self, request: dict[str, Any]) -> None:
        name = request["call"]
        client = self._caller(name)

        def ready() -> bool:
            if not client.service_is_ready():
                return False
            client.call_async(Trigger.Request()).add_done_callback(ended)
            return True

        def ended(future: Any) -> None:
            response = future.result()
            answer(answer=name, success=response.success, message=response.message)

        self.waiting.append(ready)

    def _caller(self, name: str) -> Any:
        if name not in self.callers:
            self.callers[name] = self.node.create_client(Trigger, name)
        return self.callers[name]

    def serve_action(self, request: dict[str, Any]) -> None:
        def execute(goal: Any) -> Any:
            sequence = [0, 1]
            for _ in range(goal.request.order):
                if goal.is_cancel_requested:
                    goal.canceled()
                    return Fibonacci.Result(sequence=sequence)
                sequence.append((sequence[-1] + sequence[-2]) % 10_000)
                goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
                time.sleep(request["pause_s"])
            goal.succeed()
            return Fibonacci.Result(sequence=sequence)

        self.kept.append(
            ActionServer(
                self.node,
                Fibonacci,
                request["serve_action"],
                execute,
                callback_group=self.group,
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            )
        )

    def goal(self, request: dict[str, Any]) -> None:
        name = request["goal"]
        client = self._action(name)

        def ready() -> bool:
            if not client.server_is_ready():
                return False
            sent = client.send_goal_async(Fibonacci.Goal(order=request["order"]), feedback_callback=fed)
            sent.add_done_callback(started)
            return True

        def fed(message: Any) -> None:
            answer(feedback=name, sequence=list(message.feedback.sequence))

        def started(future: Any) -> None:
            goal = self.goals[name] = future.result()
            answer(accepted=goal.accepted)
            if goal.accepted:
                goal.get_result_async().add_done_callback(ended)

        def ended(future: Any) -> None:
            response = future.result()
            answer(result=name, sequence=list(response.result.sequence), status=response.status)

        self.waiting.append(ready)

    def _action(self, name: str) -> Any:
        if name not in self.actions:
            self.actions[name] = ActionClient(self.node, Fibonacci, name, callback_group=self.group)
        return self.actions[name]

    def cancel(self, request: dict[str, Any]) -> None:
        canceled = self.goals[request["cancel"]].cancel_goal_async()
        canceled.add_done_callback(lambda future: answer(canceling=len(future.result().goals_canceling)))

    def is_available(self, request: dict[str, Any]) -> None:
        name = request["is_available"]
        answer(available=self._caller(name).service_is_ready(), of=name)

    def execute(self, request: dict[str, Any]) -> None:
        getattr(self, next(iter(request)))(request)

    def work(self) -> None:
        self.waiting = [ready for ready in self.waiting if not ready()]


def main() -> None:
    requests: Queue[dict[str, Any] | None] = Queue()

    def read() -> None:
        for line in sys.stdin:
            requests.put(json.loads(line))
        requests.put(None)

    rclpy.init(args=[])
    node = rclpy.create_node(sys.argv[1])
    executor = MultiThreadedExecutor(2)
    executor.add_node(node)
    robot = Robot(node)
    threading.Thread(target=read, daemon=True).start()
    answer(ready=True)
    for request in iter(functools.partial(_next_request, requests, executor, robot), None):
        robot.execute(request)
    node.destroy_node()
    rclpy.try_shutdown()


def _next_request(requests: Queue[dict[str, Any] | None], executor: Any, robot: Robot) -> dict[str, Any] | None:
    """Spins until there is a request; None at the end of input."""
    while True:
        executor.spin_once(timeout_sec=0.02)
        robot.work()
        try:
            return requests.get_nowait()
        except Empty:
            continue


if __name__ == "__main__":
    main()
