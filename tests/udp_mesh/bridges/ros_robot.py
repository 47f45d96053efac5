"""A robot's ROS node for tests, in ROS's own interpreter: commands as JSON lines in, messages as JSON lines out.

{"serve": SERVICE, "delay_s": how long a call takes, "refuse": BOOL}, of the type made/Add; {"add": SERVICE, "a", "b"}
calls it: {"added": SERVICE, "sum" or "error"}; {"exists": SERVICE} -> {"exists": BOOL};
{"serve_action": NAME} of actionlib's TestAction, which ends at once, or with a negative goal when it is canceled;
{"goal": NAME, "number": N} -> "feedback", and "ended": NAME with "state" and "result"; {"cancel": NAME};
{"subscribe": NAME, "type": TYPE or "*", "delay_s": how long each message keeps the subscriber busy};
{"publish": NAME, "type": TYPE, "data": VALUE, "latch": BOOL, "repeat": how often}; {"stream": NAME, "type": TYPE,
"rate_hz": HZ, "bytes": SIZE}; {"stop_streams": true}; {"call": SERVICE}.

What arrives is {"name", "type", "md5sum", "definition", "latching"} and one of "data" (typed; with a header, as Python
shows the message), "number" (of an image),
"text" (of a legacy message) or "hex" (of "*"). TYPE may be one that is installed
nowhere: then "md5sum" and "definition" stand in the command, and the data is hex.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any

import genpy.dynamic
import roslib.message
import rospy

publishers: dict[Any, Any] = {}
subscribers: list[Any] = []
services: list[Any] = []
actions: dict[str, Any] = {}
streams: dict[str, Any] = {}
streamed: dict[str, int] = {}
printing = threading.Lock()
MAX_HEX_BYTES = 1000


def say(**fields: object) -> None:
    with printing:
        sys.stdout.write(json.dumps(fields) + "\n")
        sys.stdout.flush()


def arrived(message: Any, about: tuple[str, float]) -> None:
    name, delay_s = about
    header = message._connection_header
    fields = {"name": name, "type": header["type"], "md5sum": header["md5sum"], "latching": header.get("latching")}
    fields["definition"] = header.get("message_definition")
    if isinstance(message, rospy.AnyMsg):
        fields["bytes"] = len(message._buff)
        fields["hex"] = message._buff[:MAX_HEX_BYTES].hex()
    elif header["type"] == "sensor_msgs/Image":
        fields.update(bytes=len(message.data), number=message.header.seq, at=time.monotonic())
        fields.pop("definition")
    elif header["type"] in ("udp_mesh/NetworkStats", "udp_mesh/HostEntry"):
        fields["text"] = str(message)
    elif hasattr(message, "header"):
        fields["data"] = str(message)
    else:
        fields.update(data=message.data, at=time.monotonic())
    say(**fields)
    if delay_s:
        time.sleep(delay_s)


def subscribe(command: dict[str, Any]) -> None:
    name = command["subscribe"]
    if command["type"] == "*":
        wanted: Any = rospy.AnyMsg
    elif "definition" in command:
        wanted = genpy.dynamic.generate_dynamic(command["type"], command["definition"])[command["type"]]
    else:
        wanted = roslib.message.get_message_class(command["type"])
    about = (name, command.get("delay_s", 0.0))
    subscribers.append(rospy.Subscriber(name, wanted, arrived, callback_args=about, buff_size=1 << 24))
    say(subscribed=name)


def publish(command: dict[str, Any]) -> None:
    name, type_name = command["publish"], command["type"]
    if (name, type_name) not in publishers:
        for other in [key for key in publishers if key[0] == name]:
            publishers.pop(other)[0].unregister()
        message_class = roslib.message.get_message_class(type_name) if "md5sum" not in command else None
        if message_class is None:
            fields = {"_type": type_name, "_md5sum": command["md5sum"], "_full_text": command["definition"]}
            message_class = type("Made", (rospy.AnyMsg,), fields)
        publisher = rospy.Publisher(name, message_class, queue_size=10_000, latch=command.get("latch", False))
        publishers[name, type_name] = publisher, message_class
    publisher, message_class = publishers[name, type_name]
    for number in range(command.get("repeat", 1)):
        message = message_class()
        if not isinstance(message, rospy.AnyMsg):
            message.data = f"{command['data']}{number}" if "repeat" in command else command["data"]
        elif "zeros" in command:
            message._buff = bytes(command["zeros"])
        else:
            message._buff = bytes.fromhex(command["data"])
        publisher.publish(message)
    say(connections=publisher.get_num_connections())


def stream(command: dict[str, Any]) -> None:
    name, stop = command["stream"], threading.Event()
    streams[name] = stop
    message_class: Any = roslib.message.get_message_class(command["type"])
    publisher = rospy.Publisher(name, message_class, queue_size=10)

    def run() -> None:
        number = 0
        while not stop.wait(1.0 / command["rate_hz"]):
            message = message_class()
            number += 1
            if "picture" in command:
                message.width, message.height = command["picture"]
                message.encoding, message.step = "rgb8", 3 * message.width
                message.data = bytes(message.step * message.height)
            elif command["type"] == "sensor_msgs/Image":
                message.header.seq = number
                # Pixels that do not compress.
                message.data = command["bytes"] // len(NOISE) * NOISE
            else:
                message.data = json.dumps({"number": number, "at": time.monotonic()})
            publisher.publish(message)
            streamed[name] = number

    threading.Thread(target=run, daemon=True).start()


with open("/dev/urandom", "rb") as source:
    NOISE = source.read(10_000)


class GetHosts:
    """The legacy service as its package defines it."""

    _type = "udp_mesh/GetHosts"
    _md5sum = "240aa9a842ed6592e7a3e693aebc36a4"
    _request_class: Any = genpy.dynamic.generate_dynamic("udp_mesh/Request", "")["udp_mesh/Request"]
    _response_class: Any = genpy.dynamic.generate_dynamic("udp_mesh/Response", "string[] hosts\nstring[] macs")[
        "udp_mesh/Response"
    ]


class Add:
    """A service whose package is installed nowhere."""

    _type = "made/Add"
    _md5sum = "0123456789abcdef" * 2
    _request_class: Any = genpy.dynamic.generate_dynamic("made/AddRequest", "int64 a\nint64 b")["made/AddRequest"]
    _response_class: Any = genpy.dynamic.generate_dynamic("made/AddResponse", "int64 sum")["made/AddResponse"]


def serve(command: dict[str, Any]) -> None:
    def added(request: Any) -> Any:
        say(serving=command["serve"])
        time.sleep(command.get("delay_s", 0.0))
        if command.get("refuse"):
            raise rospy.ServiceException("no sums today")
        return Add._response_class(request.a + request.b)

    services.append(rospy.Service(command["serve"], Add, added))
    say(serves=command["serve"])


def add(command: dict[str, Any]) -> None:
    name = command["add"]

    def run() -> None:
        try:
            answer = {"sum": rospy.ServiceProxy(name, Add)(command["a"], command["b"]).sum}
        except rospy.ServiceException as error:
            answer = {"error": str(error)}
        say(added=name, **answer)

    threading.Thread(target=run, daemon=True).start()


def serve_action(name: str) -> None:
    import actionlib
    from actionlib.msg import TestAction, TestFeedback, TestResult

    def execute(goal: Any) -> None:
        say(executing=goal.goal)
        while goal.goal < 0:
            if server.is_preempt_requested():
                server.set_preempted(TestResult(-1))
                return
            server.publish_feedback(TestFeedback(7))
            time.sleep(0.1)
        server.set_succeeded(TestResult(goal.goal + 1))

    server = actionlib.SimpleActionServer(name, TestAction, execute, auto_start=False)
    server.start()
    services.append(server)
    say(serves_action=name)


def goal(command: dict[str, Any]) -> None:
    import actionlib
    from actionlib.msg import TestAction, TestGoal

    name = command["goal"]
    if name not in actions:
        actions[name] = actionlib.SimpleActionClient(name, TestAction)

    def run() -> None:
        client = actions[name]
        say(available=client.wait_for_server(rospy.Duration(60)))
        reported: list[int] = []

        def feedback(message: Any) -> None:
            if not reported:
                reported.append(message.feedback)
                say(feedback=message.feedback)

        client.send_goal(TestGoal(command["number"]), feedback_cb=feedback)
        client.wait_for_result()
        result = client.get_result()
        say(ended=name, state=client.get_state(), result=None if result is None else result.result)

    threading.Thread(target=run, daemon=True).start()


def exists(name: str) -> bool:
    try:
        rospy.wait_for_service(name, timeout=0.2)
    except rospy.ROSException:
        return False
    return True


rospy.init_node(sys.argv[1], disable_signals=True)
say(ready=True)
for line in sys.stdin:
    command = json.loads(line)
    if "subscribe" in command:
        subscribe(command)
    elif "stream" in command:
        stream(command)
    elif "stop_streams" in command:
        for event in streams.values():
            event.set()
        say(streamed=streamed)
    elif "serve" in command:
        serve(command)
    elif "serve_action" in command:
        serve_action(command["serve_action"])
    elif "goal" in command:
        goal(command)
    elif "cancel" in command:
        actions[command["cancel"]].cancel_goal()
    elif "add" in command:
        add(command)
    elif "exists" in command:
        say(exists=exists(command["exists"]))
    elif "call" in command:
        rospy.wait_for_service(command["call"])
        response = rospy.ServiceProxy(command["call"], GetHosts)()
        say(answer={"hosts": list(response.hosts), "macs": list(response.macs)})
    else:
        publish(command)
rospy.signal_shutdown("end of input")
