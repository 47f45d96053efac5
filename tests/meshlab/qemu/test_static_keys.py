"""The machine's kernel stamps packets from its start on, so that no ping rewrites its code."""

import socket

import pytest

from meshlab.qemu import control
from meshlab.qemu.static_keys import hold_time_stamps
from tests.meshlab.qemu.conftest import Lab

SO_TIMESTAMP = 29

# of each socket of process 1, by pidfd_getfd(2)
HELD = f"""
import ctypes, os, socket
call = ctypes.CDLL(None, use_errno=True).syscall
pid = os.pidfd_open(1)
for number in os.listdir("/proc/1/fd"):
    if os.readlink("/proc/1/fd/" + number).startswith("socket:"):
        with socket.socket(fileno=call(438, pid, int(number), 0)) as copy:
            if copy.getsockopt(socket.SOL_SOCKET, {SO_TIMESTAMP}):
                print("held")
"""


def test_a_held_socket_has_its_packets_stamped() -> None:
    with hold_time_stamps() as held:
        assert held.getsockopt(socket.SOL_SOCKET, SO_TIMESTAMP) == 1


@pytest.mark.lab
@pytest.mark.xdist_group("lab-real")
@pytest.mark.timeout(1800)
def test_process_1_of_the_machine_holds_one(lab: Lab) -> None:
    control.run(lab.fleet.directory, f"cat >/run/held.py <<'END'{HELD}END").check("write a program")
    done = control.run(lab.fleet.directory, "python3 /run/held.py")
    assert done.check("look at the sockets of process 1").stdout == "held\n"
