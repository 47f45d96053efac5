"""udp_mesh between two robots' computers, across the mesh: telemetry flows again after a relay has died.

How long that takes is measured by benchmarks/reconvergence_udp_mesh.py; here it has to happen.
"""

from __future__ import annotations

import importlib.util
import io
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.reconvergence_fleet import PROGRAMS
from meshlab.placement import flush_stations
from meshlab.qemu import control
from tests.meshlab.qemu.conftest import Lab, until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]

# many messages, where ten a second are sent
PLENTY = 30
_COMMAND_S = 120.0
_UPLOAD_S = 300.0
_PYTHON = "env PYTHONPATH=/opt/telemetry python3"
_START = """
mkdir -p /run/mesh-{robot}
cat >/run/mesh-{robot}/config.toml <<END
name = "{robot}"
key_file = "/run/mesh-{robot}/key"
[topics]
telemetry = {{ priority = 3, reliable = false, keep_last = 1, destinations = ["base-station"] }}
[daemon]
socket = "/run/mesh-{robot}/socket"
state_directory = "/run/mesh-{robot}"
END
(umask 077; echo {key} >/run/mesh-{robot}/key)
cat >/run/mesh-{robot}/run.py <<END
from udp_mesh.cli.main import main
main(["run", "/run/mesh-{robot}/config.toml"])
END
ip netns exec pc.{robot} {python} /run/mesh-{robot}/run.py >/run/mesh-{robot}/log 2>&1 </dev/null &
echo $! >>/run/mesh-pids
"""
_CLIENT = (
    "{python} /opt/telemetry/telemetry.py {words} >/run/mesh-client.log 2>&1 </dev/null & echo $! >>/run/mesh-pids"
)


def on_machine(lab: Lab, command: str) -> str:
    return control.run(lab.fleet.directory, command, timeout_s=_COMMAND_S).check(command[:80]).stdout


def put_programs(lab: Lab) -> None:
    """Copy udp_mesh, its cryptography package and the benchmark's client into the machine."""
    archive = io.BytesIO()
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for name in ("udp_mesh", "cryptography"):
            found = importlib.util.find_spec(name)
            assert found is not None
            assert found.origin is not None
            tar.add(Path(found.origin).parent, name, filter=lambda item: None if "__pycache__" in item.name else item)
        tar.add(PROGRAMS / "telemetry.py", "telemetry.py")
    with tempfile.TemporaryFile() as source, tempfile.TemporaryFile() as said:
        source.write(archive.getvalue())
        source.seek(0)
        command = "mkdir -p /opt/telemetry && tar -x -C /opt/telemetry"
        descriptors = (source.fileno(), said.fileno(), said.fileno())
        answer = lab.fleet.request_with_fds(descriptors, _UPLOAD_S, "machine", command=command)
        said.seek(0)
        assert answer["status"] == 0, said.read().decode(errors="replace")


@contextmanager
def telemetry(lab: Lab) -> Iterator[None]:
    """The Husky's computer sends the base station's ten messages a second."""
    for robot in ("base-station", "husky"):
        on_machine(lab, _START.format(robot=robot, python=_PYTHON, key="be" * 32))
    try:
        for robot, words in (
            ("base-station", "record /run/mesh-base-station/socket /run/arrivals"),
            ("husky", "send /run/mesh-husky/socket 0.1"),
        ):
            until(lambda: is_there(lab, f"/run/mesh-{robot}/socket"), f"{robot}'s daemon")  # noqa: B023
            on_machine(lab, _CLIENT.format(python=_PYTHON, words=words))
        yield
    finally:
        on_machine(lab, "kill $(cat /run/mesh-pids); rm /run/mesh-pids")


def is_there(lab: Lab, path: str) -> bool:
    return control.run(lab.fleet.directory, f"[ -e {path} ]").exit_status == 0


def arrived(lab: Lab) -> int:
    """The number of received messages."""
    return int(on_machine(lab, "cat /run/arrivals 2>/dev/null | wc -l"))


def test_telemetry_flows_again_when_a_relay_has_died(lab: Lab) -> None:
    put_programs(lab)
    # a second route for the relay's neighbors, and a worse one
    lab.meshctl("lab", "link", "base", "b02", "--loss", "0.3")
    try:
        with telemetry(lab):
            until(lambda: "base" in lab.neighbors("b02"), "the other route to exist")
            until(lambda: lab.originators("b02").get("base") == "b01", "the route over the relay to be the better one")
            until(lambda: arrived(lab) > PLENTY, "telemetry over the relay")
            lab.fleet.inject_fault("b01", "off")
            until(lambda: lab.originators("b02").get("base") == "base", "the route without the relay")
            before = arrived(lab)
            until(lambda: arrived(lab) > before + PLENTY, "telemetry without the relay")
            assert not lab.node("b01").is_up()
    finally:
        # else they would be half deaf to it: it is back within the minute before Linux drops its entry
        flush_stations(lab.fleet, "b01")
        lab.fleet.repair("b01")
        lab.meshctl("lab", "mend", "base-b02")
    until(lambda: "base" not in lab.neighbors("b02"), "the links to be as they were")
    lab.settle()
