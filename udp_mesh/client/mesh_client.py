"""A client of the udp-mesh daemon in a single file: standard library, Python 3.8 or later. Copy it where you need it.

    with MeshClient() as mesh:
        mesh.subscribe("status")
        mesh.publish("status", b"ready", to="base")
        for message in mesh.messages():
            print(message.source, message.topic, message.payload)

On the daemon's Unix socket both sides send frames: two big-endian 32-bit lengths, a JSON object of the first length
(the header), raw bytes of the second (the payload). A request has "op" and a number "id"; its reply repeats the id
and has "ok". Unsolicited frames of the daemon have "event". docs/local-api.md lists them all.

Threads may share a client: each gets the replies to its own requests, and each message goes to one of those that wait
for messages. `close` from another thread ends the waits.
"""

import contextlib
import itertools
import json
import os
import select
import socket
import stat
import struct
import threading
import time
from collections import deque
from typing import Any, Callable, Deque, Dict, Iterator, List, NamedTuple, Optional, Set, Tuple, TypeVar, Union

DEFAULT_SOCKET = "/run/udp-mesh/udp-mesh.sock"
SOCKET_VARIABLE = "UDP_MESH_SOCKET"
"""Environment variable that names another socket."""
MAX_HEADER_BYTES = 1 << 16
"""Maximum header size of a request, enforced by the daemon."""
MAX_REPLY_HEADER_BYTES = 1 << 26
"""Maximum header size of a reply or event: the status of a thousand peers takes some megabytes."""
MAX_PAYLOAD_BYTES = 1 << 30
MAX_UNREAD_BYTES = 1 << 26
"""Of events that came before a reply and that the program has not taken yet. Beyond, the oldest are dropped."""
EVENT_BYTES = 1 << 10
"""What an event without payload is counted as."""
_LENGTHS = struct.Struct(">II")
_TIMEVALS = (struct.Struct("@ll"), struct.Struct("=qq"))
"""What a timeout of the kernel may be: the second, on 32-bit systems whose libc has 64-bit times."""
_READ_BYTES = 1 << 18

Header = Dict[str, Any]
Frame = Tuple[Header, bytes]
T = TypeVar("T")


class MeshError(Exception):
    """The daemon refused a request or cannot be reached, or the client was closed. `code` is a word such as
    "unknown-topic", "unreachable", "timeout" or "closed"."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class Message(NamedTuple):
    """One received message."""

    source: str
    topic: str
    type: str
    payload: bytes
    priority: int
    broadcast: bool
    receipt: Optional[int] = None
    """To pass to `MeshClient.acknowledge` once the message is processed. None: nothing waits for that."""
    number: Optional[int] = None
    """Its number in its source's log, if the topic is one: (source, topic, number) names the item."""


class MessageOutcome(NamedTuple):
    """How a message to one peer ended."""

    peer: str
    outcome: str
    """"delivered", "expired" or "peer-lost"."""
    reason: str = ""
    """Why it expired."""
    latency_s: Optional[float] = None
    """From its acceptance until it was acknowledged."""

    @property
    def delivered(self) -> bool:
        return self.outcome == "delivered"


def encode_frame(header: Header, payload: Union[bytes, memoryview] = b"") -> bytes:
    """Encodes one frame. Raises TypeError for a payload that is no buffer of bytes."""
    head = json.dumps(header, separators=(",", ":")).encode()
    data = memoryview(payload)  # `len` of an array, such as an image, is not its size in bytes
    return b"".join((_LENGTHS.pack(len(head), data.nbytes), head, data))


class FrameReader:
    """Decodes a byte stream into frames. Raises MeshError for an invalid frame."""

    def __init__(self, max_payload_bytes: int = MAX_PAYLOAD_BYTES) -> None:
        self._buffer = bytearray()
        self._max_payload_bytes = max_payload_bytes
        self._needed = _LENGTHS.size

    def feed(self, data: bytes) -> List[Frame]:
        """Returns the frames that these bytes complete."""
        buffer = self._buffer
        buffer += data
        frames: List[Frame] = []
        start = 0
        while len(buffer) - start >= self._needed:
            head_bytes, payload_bytes = _LENGTHS.unpack_from(buffer, start)
            if head_bytes > MAX_REPLY_HEADER_BYTES or payload_bytes > self._max_payload_bytes:
                text = "frame too long: header of {} bytes, payload of {} bytes".format(head_bytes, payload_bytes)
                raise MeshError("bad-frame", text)
            body = start + _LENGTHS.size
            end = body + head_bytes + payload_bytes
            if len(buffer) < end:
                self._needed = end - start
                break
            with memoryview(buffer) as view:
                frames.append(
                    (parse_header(bytes(view[body : body + head_bytes])), bytes(view[body + head_bytes : end]))
                )
            start = end
            self._needed = _LENGTHS.size
        del buffer[:start]
        return frames


def parse_header(raw: bytes) -> Header:
    """Parses a header. Raises MeshError ("bad-frame") if it is not a JSON object."""
    try:
        header = json.loads(raw.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise MeshError("bad-frame", "invalid JSON in a frame's header: {}".format(error)) from error
    if not isinstance(header, dict):
        raise MeshError("bad-frame", "a frame's header is not a JSON object")
    return header


def _is_socket(path: str) -> bool:
    try:
        return stat.S_ISSOCK(os.stat(path).st_mode)
    except OSError:
        return False


class MeshClient:
    """One connection to the daemon."""

    def __init__(self, path: Optional[str] = None, timeout_s: float = 10.0) -> None:
        """Connects to the socket at `path` (default: that of UDP_MESH_SOCKET in the environment, or the daemon's
        usual one). Raises MeshError ("unreachable") if no daemon listens there, or none answers within `timeout_s`."""
        self.path = path = path or os.environ.get(SOCKET_VARIABLE) or DEFAULT_SOCKET
        self.timeout_s = timeout_s
        self._reader = FrameReader()
        self._events: Deque[Frame] = deque()
        self._unread_bytes = 0
        self._dropped = 0
        self._requests: Set[int] = set()
        """Requests whose reply a thread waits for; a later reply is dropped."""
        self._replies: Dict[int, Frame] = {}
        self._delivering: Set[int] = set()
        """Requests whose outcome a thread waits for; these come to `_outcomes`."""
        self._outcomes: Dict[int, Header] = {}
        self._ids = itertools.count(1)
        self._write_lock = threading.Lock()
        self._arrived = threading.Condition()
        """Guards what arrived and the two below; notified when something arrives."""
        self._is_reading = False
        """Whether a thread reads the socket, for itself and the others."""
        self._is_closed = False
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        # A process-wide default timeout (rospy sets one) must not apply here. The kernel's ends a `connect` to a daemon
        # that hangs, which with a timeout of Python's fails at once if others are connecting.
        self._socket.settimeout(None)
        timeout = divmod(int(1e6 * min(max(timeout_s, 0.001), 1e6)), 1_000_000)
        for layout in _TIMEVALS:
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, layout.pack(*timeout))
                break
        try:
            self._socket.connect(path)
        except OSError as error:
            self._socket.close()
            # connect(2) also fails with "refused" for a file that is not a socket.
            reason = "not a socket" if os.path.exists(path) and not _is_socket(path) else error.strerror or error
            if isinstance(error, BlockingIOError):
                reason = "no answer within {:g} s".format(timeout_s)
            raise MeshError("unreachable", "cannot connect to the daemon at {}: {}".format(path, reason)) from error
        self._poll, self._poll_write = select.poll(), select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self._poll_write.register(self._socket, select.POLLOUT)

    def __enter__(self) -> "MeshClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection. Threads that wait for messages, or for the daemon to read, stop waiting."""
        with self._arrived:
            self._is_closed = True
            # wakes them; the one that waits for messages closes the socket
            self._break()
            if not self._is_reading:
                self._socket.close()

    def _break(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def fileno(self) -> int:
        """For `select`: if readable, `next_frame(0)` may return something. It may also do so after any other call,
        which keeps the messages that come before its reply."""
        return self._socket.fileno()

    # Requests

    def request(self, op: str, payload: bytes = b"", **fields: Any) -> Header:
        """Sends a request and returns the reply's header. Raises MeshError if it is refused or times out."""
        return self.request_frame(op, payload, **fields)[0]

    def request_frame(self, op: str, payload: bytes = b"", **fields: Any) -> Frame:
        """Like `request`, but also returns the reply's payload."""
        return self._request(next(self._ids), op, payload, fields)

    def _request(self, number: int, op: str, payload: bytes, fields: Header) -> Frame:
        self._requests.add(number)
        try:
            try:
                self._write(dict(fields, op=op, id=number), payload)
            except MeshError as error:
                if error.code == "unreachable":
                    # What the daemon sent before it closed the connection says why.
                    self._wait_for(lambda: None, 0.0)
                raise
            reply = self._wait_for(lambda: self._replies.pop(number, None), self.timeout_s)
        finally:
            with self._arrived:
                self._requests.discard(number)
                self._replies.pop(number, None)
        if reply is None:
            raise MeshError("timeout", "no reply to {!r} from the daemon within {:g} s".format(op, self.timeout_s))
        header = reply[0]
        if not header.get("ok"):
            raise MeshError(str(header.get("code", "error")), str(header.get("error", "refused")))
        return reply

    def publish(
        self,
        topic: str,
        payload: bytes,
        to: Optional[str] = None,
        type: str = "",
        notify: bool = False,
        wait: bool = True,
    ) -> Optional[int]:
        """Publishes a message; returns its number once the daemon accepted it.

        `to` names one peer (None: the topic's destinations, or all). With `notify`, an event "outcome" follows per
        destination of a reliable topic. With `wait=False` nothing is returned, and a refusal arrives as an event
        "rejected".
        """
        fields = _publication(topic, to, type, notify=notify)
        if not wait:
            self._write(dict(fields, op="publish"), payload)
            return None
        return int(self.request("publish", payload, **fields)["message"])

    def deliver(
        self, topic: str, payload: bytes, to: str, type: str = "", timeout_s: Optional[float] = None
    ) -> MessageOutcome:
        """Publishes a message of a reliable topic to one peer, and returns how it ended.

        Without `timeout_s` this takes as long as the message may: until its deadline, or until its peer is lost or
        (with an outbox) returns. After `timeout_s` seconds it raises MeshError ("timeout"); the message stays sent.
        """
        number = next(self._ids)
        self._delivering.add(number)
        try:
            reply = self._request(number, "publish", payload, _publication(topic, to, type, notify=True))[0]
            if not reply.get("reliable", True):
                raise MeshError("best-effort", "topic {} is best effort and reports no outcomes".format(topic))
            ended = self._wait_for(lambda: self._outcomes.pop(number, None), timeout_s)
        finally:
            self._delivering.discard(number)
            self._outcomes.pop(number, None)
        if ended is None:
            raise MeshError("timeout", "{} to {} has no outcome after {} s".format(topic, to, timeout_s))
        return MessageOutcome(to, str(ended["outcome"]), str(ended.get("reason", "")), ended.get("latency_s"))

    def subscribe(
        self,
        *topics: str,
        acknowledge: bool = False,
        rate_hz: Optional[float] = None,
        max_age_s: Optional[float] = None,
    ) -> None:
        """Subscribes to topics; patterns such as "map/*" and "*" are allowed.

        Peers send only what programs read. With `rate_hz`, only the newest message of each interval comes from each
        source; with `max_age_s`, none that is older when a peer gets to send it.

        With `acknowledge`, messages of topics whose outboxes are on disk have receipts. The daemon keeps each one,
        and sends it to the next program, until `acknowledge` is called for it.
        """
        given: Header = {"acknowledge": acknowledge or None, "rate_hz": rate_hz, "max_age_s": max_age_s}
        fields = {name: value for name, value in given.items() if value is not None}
        self.request("subscribe", topics=list(topics), **fields)

    def acknowledge(self, *receipts: int) -> int:
        """Tells the daemon that these messages are processed; returns how many it still kept."""
        return int(self.request("acknowledge", receipts=list(receipts))["acknowledged"])

    # Receive

    def messages(self, timeout_s: Optional[float] = None) -> Iterator[Message]:
        """Yields messages as they arrive; drops other events. Ends after `timeout_s` without one (None: never), and
        when another thread closes the client."""
        while True:
            try:
                frame = self.next_frame(timeout_s)
            except MeshError as error:
                if error.code == "closed":
                    return
                raise
            if frame is None:
                return
            message = as_message(frame)
            if message is not None:
                yield message

    def next_frame(self, timeout_s: Optional[float] = None) -> Optional[Frame]:
        """The next event with its payload; None after `timeout_s` seconds. Raises MeshError when the daemon is gone or
        the client was closed. An event "dropped" counts the messages that a program lost which made requests and did
        not take their events."""
        return self._wait_for(self._next_event, timeout_s)

    def _next_event(self) -> Optional[Frame]:
        if self._dropped:
            dropped, self._dropped = self._dropped, 0
            return {"event": "dropped", "messages": dropped}, b""
        return self._pop_event() if self._events else None

    def _pop_event(self) -> Frame:
        frame = self._events.popleft()
        self._unread_bytes -= EVENT_BYTES + len(frame[1])
        return frame

    # The socket

    def _write(self, header: Header, payload: bytes) -> None:
        frame = encode_frame(header, payload)
        head_bytes = _LENGTHS.unpack_from(frame)[0]
        if head_bytes > MAX_HEADER_BYTES:
            text = "request header too long: expected at most {} bytes, found {}".format(MAX_HEADER_BYTES, head_bytes)
            raise MeshError("bad-request", text)
        try:
            with self._write_lock:
                self._send(memoryview(frame))
        except OSError as error:
            raise self._gone("the daemon closed the connection: {}".format(error.strerror)) from error

    def _send(self, rest: memoryview) -> None:
        """Sends a frame as the daemon reads it. If it is left incomplete, by a daemon that hangs or a Ctrl-C, the
        connection ends: the daemon would take what follows for the rest of this frame."""
        started = False
        try:
            while rest:
                try:
                    rest = rest[self._socket.send(rest, socket.MSG_DONTWAIT) :]
                    started = True
                except BlockingIOError:
                    if not self._poll_write.poll(1000 * self.timeout_s):
                        text = "the daemon has read nothing for {:g} s".format(self.timeout_s)
                        raise MeshError("timeout", text) from None
        finally:
            if started and rest:
                self._break()

    def _wait_for(self, take: Callable[[], Optional[T]], timeout_s: Optional[float]) -> Optional[T]:
        """Waits until `take` finds something among the received frames; None after `timeout_s` seconds. One of the
        threads that wait reads."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        with self._arrived:
            while True:
                found = take()
                if found is not None:
                    return found
                if self._is_closed:
                    raise self._gone("")
                left_s = None if deadline is None else deadline - time.monotonic()
                if self._is_reading:
                    if not self._arrived.wait(left_s):
                        return take()
                elif not self._read_for_all(left_s):
                    return take()

    def _read_for_all(self, timeout_s: Optional[float]) -> bool:
        """Reads once, while other threads may take what arrived; False on timeout."""
        self._is_reading = True
        self._arrived.release()
        try:
            return self._read(timeout_s)
        finally:
            self._arrived.acquire()
            self._is_reading = False
            if self._is_closed:
                self._socket.close()
            self._arrived.notify_all()

    def _gone(self, reason: str) -> MeshError:
        """The error for a closed connection, with the daemon's reason if it sent one."""
        if self._is_closed:
            return MeshError("closed", "the client was closed")
        for header, _ in self._events:
            if header.get("event") == "rejected" and header.get("code") == "too-many-clients":
                return MeshError(
                    "too-many-clients", "the daemon refused the connection: {}".format(header.get("error"))
                )
        return MeshError("unreachable", reason)

    def _read(self, timeout_s: Optional[float]) -> bool:
        """Reads once; False on timeout."""
        if not self._poll.poll(None if timeout_s is None else max(0.0, timeout_s) * 1000):
            return False
        try:
            if not self._read_once():
                raise self._gone("the daemon closed the connection")
        except OSError as error:
            raise self._gone("the daemon closed the connection: {}".format(error.strerror)) from error
        return True

    def _read_once(self) -> bool:
        """Reads and decodes the available data; False at the end of the connection."""
        data = self._socket.recv(_READ_BYTES)
        if not data:
            return False
        frames = self._reader.feed(data)
        with self._arrived:
            for header, payload in frames:
                number = header.get("id")
                if isinstance(number, int) and "event" not in header:
                    if number in self._requests:
                        self._replies[number] = (header, payload)
                elif header.get("event") == "outcome" and header.get("request") in self._delivering:
                    self._outcomes[header["request"]] = header
                else:
                    self._events.append((header, payload))
                    self._unread_bytes += EVENT_BYTES + len(payload)
            while self._unread_bytes > MAX_UNREAD_BYTES and len(self._events) > 1:
                self._dropped += self._pop_event()[0].get("event") == "message"
        return True


def _publication(topic: str, to: Optional[str], type_name: str, *, notify: bool) -> Header:
    """The fields of a request `publish`."""
    fields: Header = {"topic": topic}
    if to is not None:
        fields["to"] = to
    if type_name:
        fields["type"] = type_name
    if notify:
        fields["notify"] = True
    return fields


def as_message(frame: Frame) -> Optional[Message]:
    """The message in an event's frame; None for other events."""
    header, payload = frame
    if header.get("event") != "message":
        return None
    return Message(
        str(header["source"]),
        str(header["topic"]),
        str(header.get("type", "")),
        payload,
        int(header["priority"]),
        bool(header["broadcast"]),
        header.get("receipt"),
        header.get("number"),
    )
