"""`udp-mesh`: arguments -> one command -> an exit code."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from udp_mesh import __version__
from udp_mesh.cli import change, hosts, inspect, serve, traffic
from udp_mesh.cli.argument_types import coordinate, count, ping_s, positive
from udp_mesh.cli.command_parser import CommandParser, HelpFormatter
from udp_mesh.cli.hints import hint
from udp_mesh.cli.output import Exit, OutputFailed, checked_stdout, discard_stdout, prepare_streams, print_error
from udp_mesh.client.mesh_client import DEFAULT_SOCKET, MeshError
from udp_mesh.daemon.interface import CONDITIONS_TOPIC, DEFAULT_PATH

Command = Callable[[argparse.Namespace], int]

EPILOG = """\
exit codes:
  0    success
  1    the daemon refused the request, a peer did not answer, or a file could not be written
  2    invalid arguments, or a file that `report` or `sim` cannot use
  3    cannot connect to the daemon
  4    invalid configuration
  5    a message was not delivered
  130  interrupted

environment:
  UDP_MESH_SOCKET  the daemon's socket, unless --socket is given

examples:
  udp-mesh check udp-mesh.toml && udp-mesh run udp-mesh.toml
  udp-mesh status --watch
  udp-mesh pub status 'ready' --to base --wait
  udp-mesh echo 'map/*'
  udp-mesh set topic video priority=9 reliable=false keep_last=1
"""

RUNS_UNTIL_INTERRUPTED: tuple[Command, ...] = (
    serve.run_daemon,
    inspect.status,
    inspect.peers,
    inspect.topics,
    inspect.logs,
    inspect.subscriptions,
    inspect.events,
    hosts.hosts,
    traffic.echo,
)
"""Commands that are normally ended with Ctrl-C, so that an interrupt is a success."""

FORWARDED = {"report": "udp_mesh.report", "sim": "udp_mesh.sim"}
"""Commands that parse their own arguments: `main(argv)` of the package is called."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the process's exit code."""
    prepare_streams()
    command: Command | None = None
    try:
        arguments = list(sys.argv[1:] if argv is None else argv)
        if arguments[:1] == ["help"]:
            arguments = [*arguments[1:], "--help"]
        if arguments and arguments[0] in FORWARDED:
            return _forward(FORWARDED[arguments[0]], arguments[1:])
        parser = build_parser()
        parser.refuse_options_first(arguments)
        parsed = parser.parse_args(arguments)
        command = parsed.command
        return command(parsed)
    except MeshError as error:
        text = hint(error)
        print_error(f"{error} ({text})" if text else str(error))
        return Exit.UNREACHABLE if error.code == "unreachable" else Exit.FAILED
    except BrokenPipeError:
        # The reader of standard output has gone away; there is nothing left to write to.
        discard_stdout()
        return Exit.FAILED
    except OutputFailed as error:
        discard_stdout()
        print_error(f"standard output: {error}")
        return Exit.FAILED
    except KeyboardInterrupt:
        return Exit.OK if command in RUNS_UNTIL_INTERRUPTED else Exit.INTERRUPTED


def _forward(package: str, arguments: list[str]) -> int:
    """Runs a package's own command, which handles errors of its files itself but not those of standard output."""
    command: Callable[[list[str]], int] = importlib.import_module(package).main
    with checked_stdout():
        code = command(arguments)
        sys.stdout.flush()
    return code


def build_parser() -> CommandParser:
    """The parser of all commands."""
    root = CommandParser(
        prog="udp-mesh",
        description="Send prioritized messages between robots over lossy, intermittent links.",
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser: argparse.ArgumentParser = root
    parser.add_argument("--version", action="version", version=f"udp-mesh {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    root.words = commands.choices
    _add_serve(commands)
    _add_inspect(commands)
    _add_change(commands)
    _add_traffic(commands)
    for name, text in (
        ("report", "turn recordings into an HTML page with charts"),
        ("sim", "run a scenario in the simulator"),
    ):
        commands.add_parser(name, help=text, add_help=False)
    return root


def _parser(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    help_text: str,
    example: str,
    earlier: Sequence[str] = (),
) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        aliases=earlier,
        help=help_text,
        description=f"{help_text[:1].upper()}{help_text[1:]}.",
        epilog=f"example: {example}",
        formatter_class=HelpFormatter,
    )


def _command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    command: Command,
    help_text: str,
    *,
    example: str,
    earlier: Sequence[str] = (),
    daemon: bool = True,
    json: bool = True,
) -> argparse.ArgumentParser:
    """`earlier`: names that it had, which are still accepted."""
    parser = _parser(commands, name, help_text, example, earlier)
    parser.set_defaults(command=command)
    if daemon:
        parser.add_argument(
            "--socket",
            default=os.environ.get("UDP_MESH_SOCKET") or DEFAULT_SOCKET,
            help="the daemon's socket (default: UDP_MESH_SOCKET, or %(default)s)",
        )
    if json:
        parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _command_group(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, help_text: str, example: str
) -> argparse._SubParsersAction[argparse.ArgumentParser]:
    """A command with subcommands."""
    parser = _parser(commands, name, help_text, example)
    return parser.add_subparsers(title="commands", metavar="COMMAND", required=True)


def _add_serve(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    run = _command(
        commands, "run", serve.run_daemon, "run the daemon", example="udp-mesh run mesh.toml", daemon=False, json=False
    )
    run.add_argument("config", type=Path, nargs="?", default=DEFAULT_PATH, help="default: %(default)s")
    run.add_argument(
        "--log-level",
        choices=("debug", "info", "warning", "error"),
        default="info",
        help="minimum level of log messages (default: %(default)s)",
    )
    check = _command(
        commands, "check", serve.check, "check a configuration", example="udp-mesh check mesh.toml", daemon=False
    )
    check.add_argument("config", type=Path, nargs="?", default=DEFAULT_PATH, help="default: %(default)s")
    keygen = _command(
        commands,
        "keygen",
        serve.keygen,
        "create a fleet key",
        example="udp-mesh keygen fleet.key",
        daemon=False,
        json=False,
    )
    keygen.add_argument("file", type=Path, help="file to create; it must not exist")


def _add_inspect(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    for name, command, text in (
        ("status", inspect.status, "show links, peers and counters"),
        ("peers", inspect.peers, "show peers and their queues"),
        ("topics", inspect.topics, "show topics and their settings"),
        ("logs", inspect.logs, "show shared logs and which nodes have their items"),
        (
            "subscriptions",
            inspect.subscriptions,
            "show what local and remote programs read, and the traffic that this saves",
        ),
    ):
        parser = _command(commands, name, command, text, example=f"udp-mesh {name} --watch 2")
        parser.add_argument(
            "--watch",
            type=positive,
            nargs="?",
            const=1.0,
            metavar="SECONDS",
            help="repeat until interrupted (default interval: 1 s)",
        )
    _command(
        commands,
        "events",
        inspect.events,
        "print events as they happen",
        example="udp-mesh events --json",
    )
    _command(
        commands, "metrics", inspect.metrics, "print metrics for Prometheus", example="udp-mesh metrics", json=False
    )
    names = _command(
        commands,
        "hosts",
        hosts.hosts,
        "print the peers' addresses as lines of a hosts file, or keep them in one",
        example="udp-mesh hosts --write /etc/hosts",
    )
    action = names.add_mutually_exclusive_group()
    action.add_argument(
        "--write", type=Path, metavar="FILE", help="keep the peers in this file until interrupted, then remove them"
    )
    action.add_argument("--remove", type=Path, metavar="FILE", help="remove the peers from this file")


def _add_change(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    setters = _command_group(
        commands, "set", "change the running daemon until its next reload or restart", "udp-mesh set window 3"
    )
    topic = _command(
        setters,
        "topic",
        change.set_topic,
        "add or change a topic",
        example="udp-mesh set topic map priority=7 outbox=all",
    )
    topic.add_argument("topic", help="name of the topic; added if it is not configured")
    topic.add_argument(
        "values",
        nargs="*",
        metavar="key=value",
        help="settings as in [topics], such as priority=9; deadline_s=none unsets one; others are not changed",
    )
    window = _command(
        setters, "window", change.set_window, "set the congestion window per peer", example="udp-mesh set window 3"
    )
    window.add_argument("window", help='"adaptive", or a fixed number of packets such as 3')
    rates = _command(
        setters,
        "rates",
        change.set_rates,
        "set the protocol's times and thresholds",
        example="udp-mesh set rates offline_s=5 heartbeat_s=0.5",
    )
    rates.add_argument("values", nargs="+", metavar="key=value", help="settings as in [rates], such as offline_s=5")
    neighbor = _command(
        setters,
        "neighbor",
        change.set_neighbour,
        "add or change a fixed neighbor",
        example="udp-mesh set neighbor 10.42.0.11 --name husky1 --legacy",
        earlier=("neighbour",),
    )
    neighbor.add_argument("address", help="10.0.0.2, 10.0.0.2:8700 or [fd00::2]:8700")
    neighbor.add_argument("--name", help="node name (required with --legacy)")
    neighbor.add_argument("--link", help="link over which the neighbor is reached")
    neighbor.add_argument("--legacy", action="store_true", help="the neighbor uses the legacy format")
    position = _command(
        setters, "position", change.set_position, "set this node's position", example="udp-mesh set position 12.5 -3"
    )
    for axis, count_of in (("x", None), ("y", None), ("z", "?")):
        position.add_argument(axis, type=coordinate, nargs=count_of, help="meters")
    position.add_argument("--frame", default="map", help="coordinate frame (default: %(default)s)")
    keys = _command(
        setters,
        "keys",
        change.set_keys,
        "load keys from a file; the first one seals",
        example="udp-mesh set keys /etc/udp-mesh/new.key",
    )
    keys.add_argument("file", type=Path, help="file with one or two keys, one per line; read by the daemon")
    droppers = _command_group(
        commands, "drop", "remove a topic or neighbor from the running daemon", "udp-mesh drop topic video"
    )
    _command(droppers, "topic", change.drop_topic, "remove a topic", example="udp-mesh drop topic video").add_argument(
        "topic", help="name of the topic"
    )
    _command(
        droppers,
        "neighbor",
        change.drop_neighbour,
        "remove a fixed neighbor",
        example="udp-mesh drop neighbor 10.42.0.11",
        earlier=("neighbour",),
    ).add_argument("address", help="address as it was set")
    _command(
        commands, "reload", change.reload, "reload the daemon's configuration file", example="udp-mesh reload --json"
    )


def _add_traffic(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    publish = _command(
        commands,
        "pub",
        traffic.publish,
        "send a message",
        example="udp-mesh pub map/diff --file map.bin --to base --wait",
    )
    publish.add_argument("topic", help="name of the topic, as in `udp-mesh topics`")
    publish.add_argument("text", nargs="?", help="the message (default or -: standard input)")
    publish.add_argument("--file", type=Path, help="send the contents of a file (- for standard input)")
    publish.add_argument("--to", metavar="PEER", help="send to one peer (default: the topic's destinations, or all)")
    publish.add_argument("--type", default="", help="type name to send with the message")
    publish.add_argument("--count", type=count, default=1, help="number of times to send it (default: %(default)s)")
    publish.add_argument("--rate", type=positive, default=1.0, metavar="HZ", help="messages per second with --count")
    publish.add_argument(
        "--wait", type=positive, nargs="?", const=60.0, metavar="SECONDS", help="wait for the outcome (default: 60 s)"
    )
    echo = _command(commands, "echo", traffic.echo, "print received messages", example="udp-mesh echo 'map/*' status")
    echo.add_argument("topics", nargs="+", metavar="TOPIC", help=f"topics or patterns, or {CONDITIONS_TOPIC}")
    echo.add_argument("--count", type=count, help="exit after this many messages")
    echo.add_argument("--timeout", type=positive, metavar="SECONDS", help="exit after this long without a message")
    echo.add_argument("--rate", type=positive, metavar="HZ", help="at most this many messages per second and source")
    echo.add_argument(
        "--max-age", type=positive, metavar="SECONDS", help="skip messages that waited longer at their sender"
    )
    echo.add_argument("--raw", action="store_true", help="write only the payloads' bytes")
    ping = _command(
        commands, "ping", traffic.ping, "measure round-trip times to a peer", example="udp-mesh ping base --count 5"
    )
    ping.add_argument("peer", help="name of the peer, as in `udp-mesh peers`")
    ping.add_argument("-c", "--count", type=count, default=4, help="number of pings (default: %(default)s)")
    ping.add_argument(
        "--interval", type=positive, default=1.0, metavar="SECONDS", help="time between pings (default: %(default)g)"
    )
    ping.add_argument(
        "--timeout", type=ping_s, default=2.0, metavar="SECONDS", help="timeout per ping (default: %(default)g)"
    )
    bench = _command(
        commands, "bench", traffic.bench, "measure the throughput to a peer", example="udp-mesh bench base"
    )
    bench.add_argument("peer", help="name of the peer, as in `udp-mesh peers`")
    bench.add_argument(
        "--size", type=count, default=200_000, metavar="BYTES", help="size per message (default: %(default)s)"
    )
    bench.add_argument(
        "--seconds",
        type=positive,
        default=5.0,
        help="how long to send (default: %(default)g); exits when everything has been delivered",
    )
    bench.add_argument(
        "--timeout",
        type=positive,
        default=60.0,
        metavar="SECONDS",
        help="exit after this long without a delivered message (default: %(default)g)",
    )
    recorders = _command_group(
        commands,
        "record",
        "record messages and conditions for `udp-mesh report`",
        "udp-mesh record start /var/lib/udp-mesh/run1.jsonl",
    )
    start = _command(
        recorders,
        "start",
        traffic.record_start,
        "start a recording",
        example="udp-mesh record start /var/lib/udp-mesh/run1.jsonl",
    )
    start.add_argument("file", type=Path, help="file to create, with the daemon's permissions; it must not exist")
    start.add_argument("--payloads", action="store_true", help="include the payloads of received messages")
    _command(recorders, "stop", traffic.record_stop, "stop the recording", example="udp-mesh record stop")


if __name__ == "__main__":
    raise SystemExit(main())
