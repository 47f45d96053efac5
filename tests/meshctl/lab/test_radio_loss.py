"""What a node misses of whom: the commands as text, and their sorting of frames in a real network namespace.

Which share netem loses is the kernel's affair, and not every kernel has netem: here its place is taken by a plain
queue, whose counter tells which frames came to it.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
from collections.abc import Iterator
from subprocess import PIPE

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.lab.namespaces import CLONE_NEWNET, setns
from meshctl.lab.radio_loss import DEVICE, Command, Missing, batch, changes, prepare, receive
from tests.meshctl.lab.conftest import until

FIRST, SECOND, THIRD = (f"02:4d:00:0{number}:00:01" for number in range(3))
senders = st.dictionaries(
    st.integers(0, 254),
    st.builds(
        Missing,
        st.lists(st.integers(0, 255).map("02:4d:00:00:00:{:02x}".format), min_size=1, max_size=3, unique=True).map(
            tuple
        ),
        st.sampled_from([0.0, 0.3, 1.0]),
        st.sampled_from([0.0, 5.0]),
    ),
    max_size=4,
)


def told(commands: list[Command]) -> list[str]:
    return [" ".join(words) for words in commands]


def test_a_sender_gets_a_class_and_a_netem_for_broadcasts_and_for_unicast_and_two_filters_per_mac() -> None:
    from_first = "match u32 0x024d0000 0xffffffff at -8 match u16 0x0001 0xffff at -4"
    assert told(changes({}, {11: Missing((FIRST,), 0.5, 5.0, 64)})) == [
        "tc class add dev ifb0 parent 1: classid 1:17 htb rate 10gbit quantum 60000",
        "tc qdisc add dev ifb0 parent 1:17 handle 26: netem limit 1000 loss 50.000000% delay 5ms rate 64kbit",
        "tc class add dev ifb0 parent 1: classid 1:18 htb rate 10gbit quantum 60000",
        "tc qdisc add dev ifb0 parent 1:18 handle 27: netem limit 1000 loss 0.781250% delay 5ms rate 64kbit",
        "tc filter add dev ifb0 parent 1: protocol all prio 1 handle 800::b1 u32 match u8 0x01 0x01 at -14 "
        f"{from_first} flowid 1:17",
        "tc filter add dev ifb0 parent 1: protocol all prio 1 handle 800::b2 u32 match u8 0x00 0x01 at -14 "
        f"{from_first} flowid 1:18",
    ]


def test_another_loss_is_a_command_for_each_kind_and_none_takes_everything_away() -> None:
    old = {0: Missing((FIRST,), 0.3)}
    assert told(changes(old, {0: Missing((FIRST,), 1.0)})) == [
        "tc qdisc change dev ifb0 parent 1:1 handle 10: netem limit 1000 loss 100.000000% delay 0ms",
        "tc qdisc change dev ifb0 parent 1:2 handle 11: netem limit 1000 loss 100.000000% delay 0ms",
    ]
    assert (
        told(changes(old, {0: Missing((FIRST,))}))
        == told(changes(old, {}))
        == [
            "tc filter del dev ifb0 parent 1: protocol all prio 1 handle 800::1 u32",
            "tc filter del dev ifb0 parent 1: protocol all prio 1 handle 800::2 u32",
            "tc class del dev ifb0 classid 1:1",
            "tc class del dev ifb0 classid 1:2",
        ]
    )


@given(senders, senders)
def test_what_is_added_is_what_is_deleted_and_no_change_is_no_command(
    one: dict[int, Missing], other: dict[int, Missing]
) -> None:
    assert changes(one, one) == []
    classes: set[str] = set()
    for commands in (changes({}, one), changes(one, other), changes(other, {})):
        for words in told(commands):
            match = re.search(r"class (add|del) .*classid (\S+)", words)
            if match and match[1] == "add":
                assert match[2] not in classes
                classes.add(match[2])
            elif match:
                classes.remove(match[2])
    assert classes == set()


def test_more_senders_than_there_are_numbers_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(ValueError, match="sender 255"):
        changes({}, {255: Missing((FIRST,), 0.5)})


def test_batches_hold_each_program_s_commands() -> None:
    assert batch(prepare(), "ip") == "link add ifb0 type ifb\nlink set ifb0 up\n"
    assert batch(prepare(), "tc") == "qdisc add dev ifb0 root handle 1: htb default 0 direct_qlen 1000\n"


# -- in a namespace --


@pytest.fixture
def radio() -> Iterator[socket.socket]:
    """A cable that stands for the air, in a network namespace of this thread: frames sent here arrive at `mesh0`."""
    outside = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    inside = _new_namespace()
    try:
        setns(inside, CLONE_NEWNET)
        run([("ip", "link", "add", "air", "type", "veth", "peer", "name", "mesh0")])
        run([("ip", "link", "set", name, "up") for name in ("air", "mesh0")])
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as air:
            air.bind(("air", 0))
            yield air
    finally:
        setns(outside, CLONE_NEWNET)
        os.close(outside)
        os.close(inside)


def _new_namespace() -> int:
    with subprocess.Popen(["unshare", "--net", "sh", "-c", "echo; read -r line"], stdin=PIPE, stdout=PIPE) as holder:
        assert holder.stdin is not None
        assert holder.stdout is not None
        holder.stdout.readline()
        space = os.open(f"/proc/{holder.pid}/ns/net", os.O_RDONLY)
        holder.stdin.close()
    return space


def run(commands: list[Command]) -> None:
    for program in ("ip", "tc"):
        words = batch(commands, program)
        plain = re.sub(r"netem limit (\d+).*", r"pfifo limit \1", words)
        subprocess.run([program, "-batch", "-"], input=plain, text=True, check=True)


def sorted_frames() -> dict[str, int]:
    """Class -> frames that came to it."""
    text = subprocess.run(["tc", "-s", "class", "show", "dev", DEVICE], capture_output=True, text=True, check=True)
    return {
        match[1]: int(match[2]) for match in re.finditer(r"class htb (\S+) .*\n Sent \d+ bytes (\d+) pkt", text.stdout)
    }


def arrived() -> int:
    """Frames that the interface's owner got, after whatever was lost on their way."""
    text = subprocess.run(["tc", "-s", "qdisc", "show", "dev", DEVICE], capture_output=True, text=True, check=True)
    match = re.search(r"htb 1: .*\n Sent \d+ bytes (\d+) pkt", text.stdout)
    assert match is not None
    return int(match[1])


def send(air: socket.socket, mac: str, frames: int, to: str = "ff:ff:ff:ff:ff:ff") -> None:
    for _ in range(frames):
        air.send(bytes.fromhex((to + mac).replace(":", "") + "4305") + bytes(60))


def test_frames_are_sorted_by_their_sender_and_all_others_pass(radio: socket.socket) -> None:
    table = {0: Missing((FIRST,), 0.3), 7: Missing((SECOND, THIRD), 1.0)}
    run([*prepare(), *receive("mesh0"), *changes({}, table)])
    for mac, frames in ((FIRST, 3), (SECOND, 4), (THIRD, 5), ("02:4d:00:00:00:02", 6)):
        send(radio, mac, frames)
    for mac, frames in ((FIRST, 7), (THIRD, 8)):
        send(radio, mac, frames, to="02:4d:00:0f:00:01")
    until(lambda: sorted_frames() == {"1:1": 3, "1:2": 7, "1:f": 9, "1:10": 8}, "27 sorted frames")
    assert arrived() >= 27 + 6


def test_a_sender_that_is_heard_well_again_is_no_longer_sorted(radio: socket.socket) -> None:
    table = {0: Missing((FIRST,), 0.3), 1: Missing((SECOND,), 0.3)}
    after = {0: Missing((FIRST,), 0.3), 1: Missing((SECOND,), 0.0), 2: Missing((THIRD,), 0.1)}
    run([*prepare(), *receive("mesh0"), *changes({}, table), *changes(table, after)])
    for mac in (FIRST, SECOND, THIRD):
        send(radio, mac, 2)
    until(lambda: sorted_frames() == {"1:1": 2, "1:2": 0, "1:5": 2, "1:6": 0}, "4 sorted frames")


def test_a_radio_interface_that_is_made_anew_needs_its_own_step_alone(radio: socket.socket) -> None:
    run([*prepare(), *receive("mesh0"), *changes({}, {0: Missing((FIRST,), 0.3)})])
    run([("ip", "link", "add", "air2", "type", "veth", "peer", "name", "mesh1")])
    run([("ip", "link", "set", name, "up") for name in ("air2", "mesh1")])
    run(receive("mesh1"))
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW) as again:
        again.bind(("air2", 0))
        send(again, FIRST, 2)
    until(lambda: sorted_frames() == {"1:1": 2, "1:2": 0}, "2 sorted frames")
