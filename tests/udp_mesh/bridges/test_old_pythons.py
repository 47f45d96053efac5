"""Bridges and client run where old ROS interpreters are: Python 3.8, the standard library, and the middleware."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import udp_mesh
from tests.udp_mesh.bridges.interpreters import older_interpreters

PACKAGE = Path(udp_mesh.__file__).parent
SOURCES = sorted(path for part in ("bridges", "client") for path in (PACKAGE / part).rglob("*.py"))
MIDDLEWARE = {
    "genpy",
    "rosgraph",
    "roslib",
    "rospy",
    "std_msgs",
    "rclpy",
    "rosidl_runtime_py",
    "zenoh",
    "yaml",
    "numpy",
    "PIL",
}
NEWER_NAMES = {
    *("removeprefix", "removesuffix", "bit_count", "pairwise", "batched", "lcm", "cache", "to_thread", "TaskGroup"),
    *("StrEnum", "Self", "Never", "assert_never", "override", "ParamSpec", "TypeAlias", "Annotated", "timeout_at"),
    *("is_relative_to", "with_stem", "readlink", "file_digest", "UTC", "nonmember", "ExceptionGroup", "randbytes"),
}
"""Of the standard library since 3.9, as far as one would write them here."""
NEWER_KEYWORDS = {("zip", "strict"), ("dataclass", "slots"), ("dataclass", "kw_only"), ("basicConfig", "encoding")}
GENERIC = {"dict", "list", "set", "tuple", "type", "frozenset", "deque", "OrderedDict", "Popen"}
RUNS = """
import sys
before = set(sys.modules)
from udp_mesh.bridges import envelope, names, relay, rmw_zenoh, types
from udp_mesh.bridges import protocol, calls, configuration, message_codec, message_types, mixed_team
from udp_mesh.bridges import reduction, transforms
from udp_mesh.bridges import daemon_client
from udp_mesh.bridges.ros1 import actions, publications
from udp_mesh.bridges.ros2 import quality
from udp_mesh.client import mesh_client

alice, bob = [relay.Relay(name, "bridge/ros1", ros_version=1, nonce=name.encode()) for name in ("alice", "bob")]
key = types.TypeKey("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1")
sent = alice.from_ros(names.Route("status", "bob"), "/node", key, "string data", True, b"hello")
got = [effect for each in sent for effect in bob.from_mesh("alice", each.topic, each.type, each.payload, 0.0)]
assert got == [relay.ToRos("/alice/mesh_comm/bob/status", key, "string data", True, b"hello")], got
greeting = alice.from_mesh("bob", "bridge/ros1", "bridge", bob.on_peer_online("alice")[0].payload, 1.0)
assert greeting and bob.tick(2.0) == []
sample = envelope.Envelope("a/b", b"payload", "", b"attached", 5, True, False, False)
assert envelope.open_envelope(envelope.seal(sample)) == sample
assert quality.parse_quality(quality.quality_text(quality.Quality())) == quality.Quality()
frames = mesh_client.FrameReader().feed(mesh_client.encode_frame({"op": "x"}, b"payload"))
assert frames == [({"op": "x"}, b"payload")]
exchanges = rmw_zenoh.TokenExchange(), rmw_zenoh.TokenExchange()
assert exchanges[0].on_announcement("bob", exchanges[1].announcement())[0] == ([], [])
print(" ".join(sorted({name.partition(".")[0] for name in set(sys.modules) - before})))
"""


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_bridges_and_client_use_python_3_8_syntax(path: Path) -> None:
    tree: ast.Module = ast.parse(path.read_text(), feature_version=(3, 8))
    assert not list(newer(tree))


def newer(tree: ast.Module) -> Iterator[str]:
    """Constructs that Python 3.8 parses but cannot run."""
    unevaluated = {id(node) for annotation in unevaluated_annotations(tree) for node in ast.walk(annotation)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr in NEWER_NAMES:
            yield f"line {node.lineno}: {node.attr}"
        if isinstance(node, ast.ImportFrom):
            yield from (f"line {node.lineno}: {name.name}" for name in node.names if name.name in NEWER_NAMES)
        if isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            for keyword in node.keywords:
                if (called, keyword.arg) in NEWER_KEYWORDS:
                    yield f"line {node.lineno}: {called}({keyword.arg}=)"
        if isinstance(node, ast.Subscript) and id(node) not in unevaluated:
            name = node.value.attr if isinstance(node.value, ast.Attribute) else getattr(node.value, "id", "")
            if name in GENERIC:
                yield f"line {node.lineno}: {name}[...] is evaluated"


def unevaluated_annotations(tree: ast.Module) -> Iterator[ast.expr]:
    """Annotations that are never evaluated: those of functions and locals, and all where the module says so."""
    postponed = any(isinstance(node, ast.ImportFrom) and node.module == "__future__" for node in tree.body)
    if not postponed:
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign):
            yield node.annotation
        elif isinstance(node, ast.FunctionDef):
            arguments = [
                *node.args.posonlyargs,
                *node.args.args,
                *node.args.kwonlyargs,
                node.args.vararg,
                node.args.kwarg,
            ]
            yield from (each.annotation for each in arguments if each is not None and each.annotation is not None)
            if node.returns is not None:
                yield node.returns


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_bridges_and_client_need_nothing_but_the_middleware(path: Path) -> None:
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            imported |= {name.name.partition(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None and not node.level:
            imported.add(node.module.partition(".")[0])
    assert imported <= sys.stdlib_module_names | MIDDLEWARE | {"udp_mesh"}


@pytest.mark.parametrize("interpreter", [sys.executable, *older_interpreters()])
def test_the_bridges_pure_modules_run_with_only_the_standard_library(interpreter: str) -> None:
    environment = {"PYTHONPATH": str(PACKAGE.parent), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [interpreter, "-S", "-W", "error", "-c", RUNS], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) <= sys.stdlib_module_names | {"udp_mesh"}
