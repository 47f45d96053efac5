"""`pub`, `echo`, `ping`, `bench`, `record`: messages through the running daemon."""

from __future__ import annotations

import argparse
import base64
import sys
import time
from pathlib import Path

from udp_mesh.cli.output import Exit, complain, milliseconds, rate, say, say_json, say_json_line, size
from udp_mesh.client.mesh_client import MeshClient, MeshError, as_message
from udp_mesh.daemon.configuration import BENCH_TOPIC, CONDITIONS_TOPIC

BENCH_BACKLOG_BYTES = 16 << 20
BENCH_BACKLOG_S = 2.0
BENCH_LEAST_BACKLOG = 4
"""What the benchmark keeps accepted and undelivered: so much time of what arrives, never fewer messages and never more
bytes. That keeps any link busy, and a slow one is done soon after the time asked for."""


def publish(arguments: argparse.Namespace) -> int:
    """Sends one message, or the same one `--count` times at `--rate` a second."""
    if arguments.file is not None and arguments.text not in (None, "-"):
        complain(f"expected the message or --file, found both: {arguments.text!r} and --file {arguments.file}")
        return Exit.USAGE
    payload = _payload(arguments)
    if payload is None:
        return Exit.FAILED
    with MeshClient(arguments.socket) as mesh:
        numbers = []
        for turn in range(arguments.count):
            if turn:
                time.sleep(1 / arguments.rate)
            number = mesh.publish(
                arguments.topic, payload, to=arguments.to, type=arguments.type, notify=arguments.wait is not None
            )
            numbers.append(number)
        if arguments.wait is None:
            if arguments.json:
                say_json_line({"topic": arguments.topic, "accepted": len(numbers)})
            return Exit.OK
        return _await_outcomes(mesh, numbers, arguments)


def _payload(arguments: argparse.Namespace) -> bytes | None:
    if arguments.text not in (None, "-"):
        return bytes(arguments.text.encode())
    if arguments.text == "-" or arguments.file is None or str(arguments.file) == "-":
        if sys.stdin.isatty():
            complain("the message is what you type now; Ctrl-D ends it")
        return sys.stdin.buffer.read()
    path: Path = arguments.file
    try:
        return path.read_bytes()
    except OSError as error:
        complain(f"{path}: {error.strerror}")
        return None


def _await_outcomes(mesh: MeshClient, numbers: list[int | None], arguments: argparse.Namespace) -> int:
    """Waits for one outcome of each message; the first that is not `delivered` decides the exit code."""
    waiting, code, deadline = set(numbers), Exit.OK, time.monotonic() + arguments.wait
    while waiting:
        frame = mesh.next_frame(max(0.0, deadline - time.monotonic()))
        if frame is None:
            hint = "" if arguments.to else " (one to all that fits a datagram has none: name a peer with --to)"
            complain(f"{len(waiting)} message(s) have no outcome within {arguments.wait:g} s{hint}")
            return Exit.NOT_DELIVERED
        fields = frame[0]
        if fields.get("event") != "outcome":
            continue
        waiting.discard(fields["message_id"])
        if fields["outcome"] != "delivered":
            code = Exit.NOT_DELIVERED
        if arguments.json:
            say_json_line(fields)
        else:
            detail = milliseconds(fields["latency_s"]) if "latency_s" in fields else fields.get("reason", "")
            say(f"{fields['outcome']} {fields['peer']} {detail}".rstrip())
    return code


def echo(arguments: argparse.Namespace) -> int:
    """Prints messages as they arrive."""
    with MeshClient(arguments.socket) as mesh:
        mesh.subscribe(*arguments.topics)
        shown = 0
        while arguments.count is None or shown < arguments.count:
            frame = mesh.next_frame(arguments.timeout)
            if frame is None:
                complain(f"nothing within {arguments.timeout:g} s")
                return Exit.FAILED
            header, payload = frame
            if header.get("topic") == CONDITIONS_TOPIC:
                say_json_line(header)
                shown += 1
                continue
            message = as_message(frame)
            if message is None:
                if header.get("event") == "dropped":
                    complain(f"too slow: {header['messages']} messages were dropped")
                continue
            shown += 1
            if arguments.raw:
                sys.stdout.buffer.write(payload)
                sys.stdout.buffer.flush()
            elif arguments.json:
                say_json_line({**header, "bytes": len(payload), "payload": base64.b64encode(payload).decode()})
            else:
                say(f"{message.source} {message.topic} p{message.priority} {size(len(payload))}  {_preview(payload)}")
    return Exit.OK


def _preview(payload: bytes) -> str:
    try:
        text = payload[:200].decode()
    except UnicodeDecodeError:
        return payload[:32].hex()
    return text if text.isprintable() else payload[:32].hex()


def ping(arguments: argparse.Namespace) -> int:
    """Round trips through both daemons, at the most urgent priority."""
    times: list[float] = []
    with MeshClient(arguments.socket, timeout_s=arguments.timeout + 5) as mesh:
        for turn in range(arguments.count):
            if turn:
                time.sleep(arguments.interval)
            try:
                reply = mesh.request("ping", peer=arguments.peer, timeout_s=arguments.timeout)
            except MeshError as error:
                if error.code in ("unreachable", "timeout"):
                    raise
                if arguments.json:
                    say_json_line({"peer": arguments.peer, "error": error.code})
                if error.code == "unknown-peer":
                    raise
                if not arguments.json:
                    say(str(error))
                continue
            times.append(reply["round_trip_s"])
            if arguments.json:
                say_json_line({"peer": arguments.peer, "round_trip_s": times[-1]})
            else:
                say(f"{arguments.peer}: {milliseconds(times[-1])}")
    if times and not arguments.json:
        say(
            f"{len(times)} of {arguments.count} answered, least {milliseconds(min(times))}, "
            f"mean {milliseconds(sum(times) / len(times))}, most {milliseconds(max(times))}"
        )
    return Exit.OK if len(times) == arguments.count else Exit.FAILED


def _backlog(size_bytes: int, delivered_per_s: float) -> int:
    """Messages of the benchmark that may be under way."""
    return max(BENCH_LEAST_BACKLOG, min(BENCH_BACKLOG_BYTES // size_bytes, int(BENCH_BACKLOG_S * delivered_per_s)))


def bench(arguments: argparse.Namespace) -> int:
    """Fills the link to a peer at the lowest priority for some seconds, and says what arrived."""
    payload = bytes(arguments.size)
    sent = delivered = 0
    outstanding: set[int] = set()
    with MeshClient(arguments.socket) as mesh:
        begun = time.monotonic()
        ended = begun
        while True:
            now = time.monotonic()
            if now - begun < arguments.seconds:
                while len(outstanding) < _backlog(arguments.size, delivered / max(ended - begun, 1e-3)):
                    number = mesh.publish(BENCH_TOPIC, payload, to=arguments.peer, notify=True)
                    assert number is not None
                    outstanding.add(number)
                    sent += 1
            elif not outstanding:
                break
            frame = mesh.next_frame(arguments.timeout)
            if frame is None:
                complain(f"no message was delivered within {arguments.timeout:g} s")
                return Exit.NOT_DELIVERED
            fields = frame[0]
            if fields.get("event") == "outcome" and fields["message_id"] in outstanding:
                outstanding.discard(fields["message_id"])
                if fields["outcome"] == "delivered":
                    delivered += 1
                    ended = time.monotonic()
    seconds = max(ended - begun, 1e-9)
    result = {
        "peer": arguments.peer,
        "messages": sent,
        "delivered": delivered,
        "bytes": delivered * arguments.size,
        "seconds": round(seconds, 3),
        "bits_per_s": round(delivered * arguments.size * 8 / seconds),
    }
    if arguments.json:
        say_json(result)
    else:
        say(
            f"{delivered} of {sent} messages of {size(arguments.size)} delivered in {seconds:.2f} s: "
            f"{rate(delivered * arguments.size * 8 / seconds)}"
        )
    return Exit.OK if delivered == sent else Exit.NOT_DELIVERED


def record_start(arguments: argparse.Namespace) -> int:
    with MeshClient(arguments.socket) as mesh:
        mesh.request("record-start", path=str(arguments.file.absolute()), payloads=arguments.payloads)
    say_json({"path": str(arguments.file.absolute())}) if arguments.json else say(f"recording to {arguments.file}")
    return Exit.OK


def record_stop(arguments: argparse.Namespace) -> int:
    with MeshClient(arguments.socket) as mesh:
        reply = mesh.request("record-stop")
    if arguments.json:
        say_json({key: reply[key] for key in ("path", "bytes", "lines")})
    else:
        say(f"{reply['path']}: {reply['lines']} lines, {size(reply['bytes'])}")
    return Exit.OK
