"""`pub`, `echo`, `ping`, `bench`, `record`: messages through the running daemon."""

from __future__ import annotations

import argparse
import base64
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from udp_mesh.cli.output import (
    Exit,
    counted,
    milliseconds,
    print_error,
    print_json,
    print_json_line,
    print_text,
    rate,
    size,
    write_bytes,
)
from udp_mesh.cli.views import Json
from udp_mesh.client.mesh_client import MAX_PAYLOAD_BYTES, MeshClient, MeshError, as_message
from udp_mesh.daemon.interface import BENCH_TOPIC, CONDITIONS_TOPIC

MAX_BENCH_BACKLOG_BYTES = 16 << 20
BENCH_BACKLOG_S = 2.0
MIN_BENCH_BACKLOG = 4
"""Limits of the benchmark's accepted and undelivered data: this much time at the measured rate, but at least this many
messages and at most this many bytes. That saturates any link, and a slow one still finishes soon."""


def publish(arguments: argparse.Namespace) -> int:
    """Sends one message, or the same one `--count` times at `--rate` per second."""
    if arguments.file is not None and arguments.text not in (None, "-"):
        print_error(f"expected either a message or --file, found both: {arguments.text!r} and --file {arguments.file}")
        return Exit.USAGE
    payload = _payload(arguments)
    if payload is None:
        return Exit.FAILED
    with MeshClient(arguments.socket) as mesh:
        destinations: set[str] = set()
        if arguments.wait is not None:
            topic = _topic(mesh, arguments.topic)
            if topic is not None and not topic["reliable"]:
                print_error(
                    f"topic {arguments.topic} is best effort and reports no outcomes: drop --wait, or make it reliable"
                )
                return Exit.USAGE
            destinations = _destinations(mesh, arguments.to, topic)
        numbers = []
        for turn in range(arguments.count):
            if turn:
                time.sleep(1 / arguments.rate)
            number = mesh.publish(
                arguments.topic, payload, to=arguments.to, type=arguments.type, notify=arguments.wait is not None
            )
            assert number is not None
            numbers.append(number)
        if arguments.wait is None:
            if arguments.json:
                print_json_line({"topic": arguments.topic, "accepted": len(numbers)})
            return Exit.OK
        return _await_outcomes(mesh, {(number, peer) for number in numbers for peer in destinations}, arguments)


def _payload(arguments: argparse.Namespace) -> bytes | None:
    if arguments.text not in (None, "-"):
        # The bytes of the command line, in any encoding.
        return os.fsencode(arguments.text)
    if arguments.text == "-" or arguments.file is None or str(arguments.file) == "-":
        if sys.stdin is None:
            print_error("expected a message or --file: standard input is closed")
            return None
        if sys.stdin.isatty():
            print_error("reading the message from the terminal; press Ctrl-D to end it")
        return _read_bounded(sys.stdin.buffer, "standard input")
    path: Path = arguments.file
    try:
        with path.open("rb") as file:
            return _read_bounded(file, str(path))
    except OSError as error:
        print_error(f"{path}: {error.strerror}")
        return None


def _read_bounded(file: BinaryIO, name: str) -> bytes | None:
    """Reads a message; prints an error and returns None if it is too large."""
    payload = file.read(MAX_PAYLOAD_BYTES + 1)
    if len(payload) > MAX_PAYLOAD_BYTES:
        print_error(f"{name}: expected at most {MAX_PAYLOAD_BYTES} bytes, found more")
        return None
    return payload


def _topic(mesh: MeshClient, name: str) -> Json | None:
    """The settings of a topic; None if it is refused."""
    reply = mesh.request("topics")
    found = [topic for topic in reply["topics"] if topic["configured"] and topic["name"] == name]
    topic: Json | None = found[0] if found else reply["undeclared"]
    return topic


def _destinations(mesh: MeshClient, to: str | None, topic: Json | None) -> set[str]:
    """Peers whose outcomes are awaited; for a message to all, those that are online."""
    if to is not None:
        return {to}
    conditions = mesh.request("status")["conditions"]
    if topic is not None and topic["destinations"]:
        return set(topic["destinations"]) - {conditions["name"]}
    return {peer["name"] for peer in conditions["peers"] if peer["online"]}


def _await_outcomes(mesh: MeshClient, waiting: set[tuple[int, str]], arguments: argparse.Namespace) -> int:
    """Waits for the outcome of each message at each destination; any outcome but `delivered` fails the command."""
    code, deadline = Exit.OK, time.monotonic() + arguments.wait
    while waiting:
        frame = mesh.next_frame(max(0.0, deadline - time.monotonic()))
        if frame is None:
            names = ", ".join(sorted({peer for _, peer in waiting}))
            hint = "" if arguments.to else " (a single-datagram broadcast has no outcome: name a peer with --to)"
            print_error(f"timed out after {arguments.wait:g} s: {len(waiting)} outcome(s) missing from {names}{hint}")
            return Exit.NOT_DELIVERED
        fields = frame[0]
        if fields.get("event") != "outcome":
            continue
        waiting.discard((fields["message_id"], fields["peer"]))
        if fields["outcome"] != "delivered":
            code = Exit.NOT_DELIVERED
        if arguments.json:
            print_json_line(fields)
        else:
            detail = milliseconds(fields["latency_s"]) if "latency_s" in fields else fields.get("reason", "")
            print_text(f"{fields['outcome']} {fields['peer']} {detail}".rstrip())
    return code


def echo(arguments: argparse.Namespace) -> int:
    """Prints messages as they arrive."""
    with MeshClient(arguments.socket) as mesh:
        mesh.subscribe(*arguments.topics, rate_hz=arguments.rate, max_age_s=arguments.max_age)
        shown = 0
        while arguments.count is None or shown < arguments.count:
            frame = mesh.next_frame(arguments.timeout)
            if frame is None:
                print_error(f"no message within {arguments.timeout:g} s")
                return Exit.FAILED
            header, payload = frame
            if header.get("topic") == CONDITIONS_TOPIC:
                print_json_line(header)
                shown += 1
                continue
            message = as_message(frame)
            if message is None:
                if header.get("event") == "dropped":
                    print_error(f"reading too slowly: dropped {counted(header['messages'], 'message')}")
                continue
            shown += 1
            if arguments.raw:
                write_bytes(payload)
            elif arguments.json:
                print_json_line({**header, "bytes": len(payload), "payload": base64.b64encode(payload).decode()})
            else:
                print_text(
                    f"{message.source} {message.topic} p{message.priority} {size(len(payload))}  {_preview(payload)}"
                )
    return Exit.OK


def _preview(payload: bytes) -> str:
    try:
        text = payload[:200].decode()
    except UnicodeDecodeError:
        return payload[:32].hex()
    return text if text.isprintable() else payload[:32].hex()


def ping(arguments: argparse.Namespace) -> int:
    """Measures round trips through both daemons at the most urgent priority; Ctrl-C prints the summary."""
    times: list[float] = []
    attempts = 0
    try:
        with MeshClient(arguments.socket, timeout_s=arguments.timeout + 5) as mesh:
            for turn in range(arguments.count):
                if turn:
                    time.sleep(arguments.interval)
                attempts += 1
                _ping_once(mesh, arguments, times)
        code = Exit.OK if len(times) == arguments.count else Exit.FAILED
    except KeyboardInterrupt:
        # The ping in progress did not get its full timeout.
        attempts = max(attempts - 1, len(times))
        code = Exit.INTERRUPTED
    except MeshError:
        if times:
            _print_summary(arguments, times, attempts)
        raise
    _print_summary(arguments, times, attempts)
    return code


def _print_summary(arguments: argparse.Namespace, times: list[float], attempts: int) -> None:
    if arguments.json:
        return
    spread = (
        f", min {milliseconds(min(times))}, mean {milliseconds(sum(times) / len(times))}, "
        f"max {milliseconds(max(times))}"
        if times
        else ""
    )
    print_text(f"{len(times)} of {attempts} answered{spread}")


def _ping_once(mesh: MeshClient, arguments: argparse.Namespace, times: list[float]) -> None:
    """Adds the round-trip time, if there was an answer. Raises MeshError if further pings are pointless."""
    try:
        reply = mesh.request("ping", peer=arguments.peer, timeout_s=arguments.timeout)
    except MeshError as error:
        if error.code in ("unreachable", "timeout"):
            raise
        if arguments.json:
            print_json_line({"peer": arguments.peer, "error": error.code})
        if error.code != "no-answer":
            raise
        if not arguments.json:
            print_text(str(error))
        return
    times.append(reply["round_trip_s"])
    if arguments.json:
        print_json_line({"peer": arguments.peer, "round_trip_s": times[-1]})
    else:
        print_text(f"{arguments.peer}: {milliseconds(times[-1])}")


def _backlog(size_bytes: int, delivered_per_s: float) -> int:
    """Number of benchmark messages that may be outstanding."""
    return max(MIN_BENCH_BACKLOG, min(MAX_BENCH_BACKLOG_BYTES // size_bytes, int(BENCH_BACKLOG_S * delivered_per_s)))


@dataclass(slots=True)
class _BenchRun:
    """Messages that a benchmark sent, and the deliveries with their times."""

    begun: float
    ended: float
    sent: int = 0
    delivered: int = 0
    outstanding: set[int] = field(default_factory=set)

    @property
    def seconds(self) -> float:
        return max(self.ended - self.begun, 1e-3)


def bench(arguments: argparse.Namespace) -> int:
    """Saturates the link to a peer at the lowest priority and reports the throughput. Ctrl-C ends it early."""
    code = Exit.OK
    with MeshClient(arguments.socket) as mesh:
        begun = time.monotonic()
        run = _BenchRun(begun, begun)
        try:
            if not _fill(mesh, arguments, run):
                print_error(f"no message was delivered within {arguments.timeout:g} s")
                code = Exit.NOT_DELIVERED
        except KeyboardInterrupt:
            code = Exit.INTERRUPTED
    arrived_bytes = run.delivered * arguments.size
    bits_per_s = arrived_bytes * 8 / run.seconds
    if arguments.json:
        result = {
            "peer": arguments.peer,
            "messages": run.sent,
            "delivered": run.delivered,
            "bytes": arrived_bytes,
            "seconds": round(run.seconds, 3),
            "bits_per_s": round(bits_per_s),
        }
        print_json(result)
    else:
        messages = f"{counted(run.sent, 'message')} of {size(arguments.size)}"
        print_text(f"{run.delivered} of {messages} delivered in {run.seconds:.2f} s: {rate(bits_per_s)}")
    return Exit.NOT_DELIVERED if code == Exit.OK and run.delivered < run.sent else code


def _fill(mesh: MeshClient, arguments: argparse.Namespace, run: _BenchRun) -> bool:
    """Sends for the given time and waits for the rest; False if nothing is delivered any more."""
    payload = bytes(arguments.size)
    while True:
        if time.monotonic() - run.begun < arguments.seconds:
            while len(run.outstanding) < _backlog(arguments.size, run.delivered / run.seconds):
                number = mesh.publish(BENCH_TOPIC, payload, to=arguments.peer, notify=True)
                assert number is not None
                run.outstanding.add(number)
                run.sent += 1
        elif not run.outstanding:
            return True
        frame = mesh.next_frame(arguments.timeout)
        if frame is None:
            return False
        fields = frame[0]
        if fields.get("event") == "outcome" and fields["message_id"] in run.outstanding:
            run.outstanding.discard(fields["message_id"])
            if fields["outcome"] == "delivered":
                run.delivered += 1
                run.ended = time.monotonic()


def record_start(arguments: argparse.Namespace) -> int:
    path = arguments.file.absolute()
    with MeshClient(arguments.socket) as mesh:
        mesh.request("record-start", path=str(path), payloads=arguments.payloads)
    print_json({"path": str(path)}) if arguments.json else print_text(f"recording to {path}")
    if _is_missing(path):
        print_error(f"warning: {path} is not visible here: the daemon's service has a private /tmp (PrivateTmp=)")
    return Exit.OK


def _is_missing(path: Path) -> bool:
    try:
        path.stat()
    except FileNotFoundError:
        return True
    except OSError:
        # A directory that only the daemon may read.
        return False
    return False


def record_stop(arguments: argparse.Namespace) -> int:
    with MeshClient(arguments.socket) as mesh:
        reply = mesh.request("record-stop")
    if arguments.json:
        print_json({key: reply[key] for key in ("path", "bytes", "lines")})
    else:
        print_text(f"{reply['path']}: {counted(reply['lines'], 'line')}, {size(reply['bytes'])}")
    return Exit.OK
