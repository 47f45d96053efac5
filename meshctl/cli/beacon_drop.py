"""`meshctl meter --deploy`: DROP NOW as a message to the robot, through the daemon of this machine."""

from __future__ import annotations

from typing import Any, Protocol

from meshctl.errors import InputError
from meshctl.placement.meter import Advice
from meshctl.robots.local_daemon import DaemonError

TOPIC = "deploy_beacon"
# the payload that the bridges publish as std_msgs/Bool with `data: true`
KINDS = {
    "ros1": ("std_msgs/Bool", b"\x01"),
    "ros2": ("std_msgs/msg/Bool reliable:volatile:1:", b"\x00\x01\x00\x00\x01"),
}


class Daemon(Protocol):
    """This machine's udp_mesh daemon."""

    def request(self, op: str, payload: bytes = b"", **fields: object) -> dict[str, Any]:
        """Raises DaemonError."""


class BeaconDrop:
    """Sends the message once whenever the advice becomes DROP NOW.

    If the daemon refuses it, or does not answer the reading that precedes it, it is sent again with the next reading
    while the advice stands. If the connection breaks meanwhile, it is not: it may have dropped a beacon.
    """

    def __init__(self, daemon: Daemon, robot: str, kind: str) -> None:
        if kind not in KINDS:
            raise InputError(f"--deploy: expected {' or '.join(KINDS)}, found {kind!r}")
        self._daemon = daemon
        self._robot = robot
        self._type, self._payload = KINDS[kind]
        self._is_sent = False

    def check(self) -> None:
        """Raises InputError if the message cannot be sent: DROP NOW would be too late to find out."""
        try:
            reply = self._daemon.request("topics")
        except DaemonError as error:
            hint = "start it (`udp-mesh run`), name its socket with --socket, or leave out --deploy"
            raise InputError(f"--deploy needs the udp_mesh daemon of this machine: {error}", hint=hint) from error
        known = [str(topic.get("name")) for topic in reply.get("topics", ())]
        if TOPIC not in known and reply.get("undeclared") is None:
            raise InputError(
                f"--deploy: the daemon has no topic {TOPIC}",
                hint=f"add `{TOPIC}: {{priority: 1}}` to the inventory's topics, then run `meshctl robots deploy`",
            )

    def step(self, advice: Advice, *, answers: bool) -> str:
        """Send what is due, if the daemon `answers`; returns what went wrong."""
        if advice is not Advice.DROP_NOW:
            self._is_sent = False
        elif not self._is_sent and answers:
            try:
                self._daemon.request("publish", self._payload, topic=TOPIC, to=self._robot, type=self._type)
            except DaemonError as error:
                self._is_sent = not error.code
                again = "sent again with the next reading" if error.code else "it may have been sent; not sent again"
                return f"the message to drop a beacon failed: {error} ({again})"
            self._is_sent = True
        return (
            "" if answers or advice is not Advice.DROP_NOW or self._is_sent else "no message to drop a beacon was sent"
        )
