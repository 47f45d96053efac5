"""The stand-ins' locks (node_root/lab/lock.sh): one holder at a time, however many wait, end or are killed."""

from __future__ import annotations

import pytest

from meshlab.fleet import VirtualFleet

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

# each process ends as soon as it has unlocked, and leaves its number for the others to find
COUNT = """
echo 0 >/tmp/count
cat >/tmp/add <<'END'
. /rom/lab/lock.sh
lock test
read -r count </tmp/count
/rom/lab/genuine/busybox usleep 1000
echo $((count + 1)) >/tmp/count
unlock test
END
for process in 1 2 3 4 5 6 7 8; do
    (for turn in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25; do sh /tmp/add; done) &
done
wait
cat /tmp/count"""

# how often a call that runs is taken for one that has ended, and the other way round for one that has
SEEN = """
. /rom/lab/netifd_call.sh
unseen=0 ended=0
for number in $(seq 200); do
	/rom/lab/genuine/busybox setsid sh -c 'while /rom/lab/genuine/busybox usleep 9000; do :; done; : lab/netifd' &
	pid=$!
	for look in 1 2 3 4 5; do is_call $pid || unseen=$((unseen + 1)); done
	kill $pid
	wait $pid
	is_call $pid || ended=$((ended + 1))
done
echo $unseen $ended
"""


def test_one_process_at_a_time_holds_a_lock(fleet: VirtualFleet) -> None:
    for _ in range(4):
        assert fleet.node("box").exec(COUNT, timeout_s=120.0).check("count").stdout.strip() == "200"


def test_the_lock_of_a_killed_process_is_free(fleet: VirtualFleet) -> None:
    killed = "sh -c '. /rom/lab/lock.sh; lock killed; kill -9 $$'"
    taken = fleet.node("box").exec(f"{killed}; . /rom/lab/lock.sh; lock killed && echo taken; unlock killed")
    assert taken.stdout.split()[-1] == "taken"


def test_a_call_of_netifd_is_seen_while_it_replaces_its_program(fleet: VirtualFleet) -> None:
    """Otherwise `wifi down; wifi up` may be handled in the wrong order."""
    counted = fleet.node("box").exec(SEEN, timeout_s=120.0).check("count")
    assert counted.stdout.split() == ["0", "200"]
