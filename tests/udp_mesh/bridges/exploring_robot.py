"""A robot's or the base's application for tests, in ROS's own interpreter, written from the interface of BOBCAT
(`dan-riley/bobcat`), the autonomy of the system that inspired this one: topics, directions, and who asks whom.

Once a period it broadcasts what it knows of itself and of others (`ma_data`): the newest task of each robot, whether
it was taken, and what each has found (artifacts, map differences). What it lacks of a robot it requests
(`dm_request`) from that robot while it is heard, else from another one that is; the answers (`dm_response`) come one
item a message. Robots pass on the tasks that the base gives, and that they were taken.

Commands are JSON lines: {"found": NAME, "bytes": SIZE}, an artifact or a map difference; {"task": TEXT, "robot": NAME}
at the base; {"report": true}, answered with {"report": {"items": {ROBOT: {NAME: SHA-1}}, "tasks": {ROBOT: TEXT},
"taken": [ROBOT, ...], "hears": [NAME, ...]}}; `taken`: the robots known to have taken their newest task.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import sys
import threading
import time
from typing import Any

import rospy
from std_msgs.msg import String

PERIOD_S = 0.5
HEARD_S = 1.5
"""Without a message for this long, another one is out of reach."""
REQUEST_S = 1.5
"""Between two requests; an item is answered again only after twice this time."""


class Robot:
    """One member of the team; `others` are the names of the rest."""

    def __init__(self, name: str, others: list[str]) -> None:
        self.name = name
        self.lock = threading.Lock()
        self.items: dict[str, dict[str, bytes]] = {each: {} for each in (name, *others)}
        self.known: dict[str, list[str]] = {each: [] for each in others}
        """What exists at each, as far as heard."""
        self.heard_at: dict[str, float] = {}
        self.tasks: dict[str, tuple[int, str]] = {}
        """By robot, the number and the text of the newest task."""
        self.taken: dict[str, int] = {}
        """By robot, the number of the newest task that it is known to have taken."""
        self.asked: list[str] = []
        self.answered_at: dict[tuple[str, str, str], float] = {}
        self.request_at = 0.0
        own = f"/{name}/mesh_comm"
        self.data = rospy.Publisher(f"{own}/ma_data", String, queue_size=1)
        self.requests = {each: rospy.Publisher(f"{own}/{each}/dm_request", String, queue_size=1) for each in others}
        self.responses = {each: rospy.Publisher(f"{own}/{each}/dm_response", String, queue_size=1) for each in others}
        for each in others:
            heard = f"/{each}/mesh_comm/{name}"
            rospy.Subscriber(f"{heard}/ma_data", String, self.on_data, each)
            rospy.Subscriber(f"{heard}/dm_request", String, self.on_request, each)
            rospy.Subscriber(f"{heard}/dm_response", String, self.on_response, each)

    def hears(self) -> list[str]:
        now = time.monotonic()
        return [each for each, at in self.heard_at.items() if now - at < HEARD_S]

    def on_data(self, message: Any, source: str) -> None:
        news = json.loads(message.data)
        with self.lock:
            self.heard_at[source] = time.monotonic()
            for robot, names in news["known"].items():
                if robot != self.name and len(names) > len(self.known[robot]):
                    self.known[robot] = names
            for robot, (number, text) in news["tasks"].items():
                if number > self.tasks.get(robot, (0, ""))[0]:
                    self.tasks[robot] = (number, text)
            for robot, number in news["taken"].items():
                self.taken[robot] = max(number, self.taken.get(robot, 0))
            if self.name in self.tasks:
                self.taken[self.name] = self.tasks[self.name][0]

    def on_request(self, message: Any, source: str) -> None:
        now = time.monotonic()
        with self.lock:
            self.heard_at[source] = now
            found = [
                (robot, name, self.items[robot][name])
                for robot, names in json.loads(message.data).items()
                for name in names
                if name in self.items[robot] and self.answered_at.get((source, robot, name), 0.0) < now
            ]
            for robot, name, _ in found:
                self.answered_at[source, robot, name] = now + 2 * REQUEST_S
        for robot, name, item in found:
            text = json.dumps({"robot": robot, "name": name, "item": base64.b64encode(item).decode()})
            self.responses[source].publish(text)
            # as BOBCAT does: its publishers have a queue of one
            time.sleep(0.05)

    def on_response(self, message: Any, source: str) -> None:
        found = json.loads(message.data)
        with self.lock:
            self.heard_at[source] = time.monotonic()
            self.items[found["robot"]][found["name"]] = base64.b64decode(found["item"])

    def turn(self) -> None:
        """Broadcast, and request what is lacking."""
        with self.lock:
            known = {**self.known, self.name: list(self.items[self.name])}
            self.data.publish(json.dumps({"known": known, "tasks": self.tasks, "taken": self.taken}))
            lacking = {
                robot: missing
                for robot, names in self.known.items()
                if (missing := [name for name in names if name not in self.items[robot]])
            }
            if not lacking or time.monotonic() < self.request_at:
                return
            hears = self.hears()
            target = next((each for each in (*lacking, *hears) if each in hears and each not in self.asked), None)
            if target is None:
                self.asked.clear()
                return
            self.asked.append(target)
            self.request_at = time.monotonic() + REQUEST_S
            self.requests[target].publish(json.dumps(lacking))

    def report(self) -> dict[str, Any]:
        with self.lock:
            items = {
                robot: {name: hashlib.sha1(item).hexdigest() for name, item in found.items()}
                for robot, found in self.items.items()
            }
            tasks = {robot: text for robot, (_, text) in self.tasks.items()}
            taken = sorted(robot for robot, (number, _) in self.tasks.items() if self.taken.get(robot) == number)
            return {"items": items, "tasks": tasks, "taken": taken, "hears": sorted(self.hears())}


def say(**fields: object) -> None:
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


def main() -> None:
    name, *others = sys.argv[1:]
    rospy.init_node(f"{name}_exploring", disable_signals=True)
    robot = Robot(name, others)

    def run() -> None:
        while True:
            robot.turn()
            time.sleep(PERIOD_S)

    threading.Thread(target=run, daemon=True).start()
    say(ready=True)
    for line in sys.stdin:
        command = json.loads(line)
        with robot.lock:
            if "found" in command:
                robot.items[name][command["found"]] = os.urandom(command["bytes"])
            elif "task" in command:
                number = robot.tasks.get(command["robot"], (0, ""))[0] + 1
                robot.tasks[command["robot"]] = (number, command["task"])
        if "report" in command:
            say(report=robot.report())


if __name__ == "__main__":
    main()
