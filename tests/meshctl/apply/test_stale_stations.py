"""Which nodes are queried for stale station entries, with which scripts, and when."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.apply.stale_stations import (
    FIRST_PAUSE_S,
    MAX_PAUSE_S,
    MAX_QUERIED,
    LoginPlace,
    StationEntry,
    by_holder,
    current_neighbors,
    entries_of,
    flush_script,
    next_query_s,
    own_entries,
    possible_holders,
    reconnect_script,
    routed_through,
    unflushed_boot_s,
    watch_script,
)
from meshctl.device.observation import Observation, Originator, Station, WirelessLink
from meshctl.plan.radios import NO_RADIOS, Radios
from tests.meshctl.plan.support import fleet, running

MAC = "02:00:00:00:01:02"
OTHER = "02:00:00:00:01:03"
BASE = "02:00:00:00:01:00"


def knows(name: str, *stations: tuple[str, str]) -> Observation:
    return replace(running(fleet(), name), stations=tuple(Station(ifname, mac) for ifname, mac in stations))


def itself(*macs: str) -> Observation:
    links = tuple(WirelessLink(f"mesh{number}", "IBSS", mac) for number, mac in enumerate(macs))
    return replace(running(fleet(), "b02"), links=links, mesh=None, macs={})


def test_holders_are_queried_with_the_interface_and_mac_they_reported() -> None:
    around = {
        "b01": knows("b01", ("mesh0", OTHER), ("mesh1", MAC.upper())),
        "b02": itself(MAC),
        "b03": knows("b03", ("mesh0", OTHER)),
        "base": knows("base", ("wlan0", MAC)),
    }
    assert entries_of("b02", around) == (StationEntry("b01", "mesh1", MAC.upper()), StationEntry("base", "wlan0", MAC))


def test_entries_of_every_radio_are_flushed() -> None:
    around = {"b01": knows("b01", ("mesh0", MAC), ("mesh0", OTHER)), "b02": itself(MAC, OTHER)}
    assert by_holder(entries_of("b02", around)) == {
        "b01": (StationEntry("b01", "mesh0", MAC), StationEntry("b01", "mesh0", OTHER))
    }


def test_an_unobserved_node_and_one_without_a_mesh_radio_have_no_holders() -> None:
    around = {"b01": knows("b01", ("mesh0", MAC))}
    assert entries_of("b02", around) == ()
    assert entries_of("b02", {**around, "b02": itself()}) == ()


def test_the_number_of_queried_holders_is_limited() -> None:
    entries = [StationEntry(f"n{number:03}", "mesh0", MAC) for number in range(200)]
    assert list(by_holder(entries)) == [f"n{number:03}" for number in range(MAX_QUERIED)]


@given(st.lists(st.floats(0, 30), max_size=20))
def test_queries_for_an_unreachable_node_back_off_up_to_the_maximum_pause(
    lateness: list[float],
) -> None:
    asked: list[float] = []
    for late_s in lateness:
        due_s = next_query_s(asked)
        asked.append(due_s + late_s if asked else late_s)
    pauses = [next_query_s(asked[: count + 1]) - asked[count] for count in range(len(asked))]
    assert next_query_s([]) < 0
    assert pauses == pytest.approx(sorted(pauses))
    assert all(FIRST_PAUSE_S - 1e-6 <= pause <= MAX_PAUSE_S + 1e-6 for pause in pauses)


def test_only_holders_of_entries_of_the_restarting_radio_are_queried() -> None:
    around = {"b01": knows("b01", ("mesh0", MAC), ("mesh1", OTHER)), "b02": itself(MAC, OTHER)}
    assert entries_of("b02", around, Radios(frozenset({"mesh1"}))) == (StationEntry("b01", "mesh1", OTHER),)
    assert entries_of("b02", around, NO_RADIOS) == ()


def hears(*macs: str) -> Observation:
    return replace(itself(MAC), neighbors=(), stations=tuple(Station("mesh0", mac) for mac in macs))


def test_unobserved_neighbors_may_hold_an_entry() -> None:
    around = {
        "b01": replace(knows("b01"), macs={}, links=(WirelessLink("mesh0", "IBSS", BASE),)),
        "b02": hears(BASE, OTHER),
    }
    names = {OTHER: "b03", MAC: "b02"}
    assert possible_holders("b02", around, names, ("b01", "b02", "b03", "b04")) == ("b03",)
    assert current_neighbors(around["b02"], {**names, BASE: "b01"}) == ("b01", "b03")


def test_a_node_observed_without_its_stations_may_hold_an_entry() -> None:
    around = {"b01": replace(knows("b01"), stations=None), "b02": hears(OTHER)}
    assert possible_holders("b02", around, {OTHER: "b01"}, ()) == ("b01",)


def test_an_unknown_mac_may_be_any_mesh_node_without_a_known_mac() -> None:
    around = {"b01": knows("b01"), "b02": hears("02:99:00:00:00:01")}
    assert possible_holders("b02", around, {OTHER: "b03"}, ("b01", "b02", "b03", "b04")) == ("b04",)
    assert possible_holders("b02", around, {"02:99:00:00:00:01": "b02"}, ("b04",)) == ()


def hop(name: str, mac: str, next_hop: str, *, best: bool = True) -> Observation:
    return replace(running(fleet(), name), originators=(Originator(mac, next_hop, "mesh0", 100, best, 200),))


def at(seen: Observation, asked_at_s: float, *, uptime_s: float | None) -> Observation:
    return replace(seen, asked_at_s=asked_at_s, answered_at_s=asked_at_s + 1.0, uptime_s=uptime_s)


@pytest.mark.parametrize(
    ("connected_s", "is_old"), [(150, True), (104, True), (102, False), (40, False), (None, False)]
)
def test_an_entry_older_than_its_nodes_boot_counts_as_unflushed(connected_s: int | None, is_old: bool) -> None:
    # it is up since 900, give or take what an answer takes; the neighbor has its entry since 1001 - connected_s
    around = {
        "b01": at(
            replace(knows("b01"), stations=(Station("mesh0", MAC, connected_s=connected_s),)), 1000, uptime_s=9e9
        ),
        "b02": at(itself(MAC), 1000.0, uptime_s=100.0),
    }
    assert unflushed_boot_s("b02", around) == (900.0 if is_old else None)
    assert unflushed_boot_s("b01", around) is None
    assert unflushed_boot_s("b02", {**around, "b02": at(itself(MAC), 1000.0, uptime_s=None)}) is None
    assert unflushed_boot_s("b03", around) is None


def test_nodes_whose_best_next_hop_to_the_base_is_the_node_are_routed_through_it() -> None:
    around = {
        "b01": hop("b01", BASE, BASE),
        "b02": itself(MAC),
        "b03": hop("b03", BASE.upper(), MAC),
        "b04": hop("b04", BASE, MAC, best=False),
        "b05": hop("b05", OTHER, MAC),
    }
    assert routed_through("b02", around, (BASE,)) == {"b03"}
    assert routed_through("b02", around, ()) == frozenset()


def test_a_node_watches_its_own_entries_on_the_radios_that_may_restart() -> None:
    seen = knows("b02", ("mesh0", OTHER), ("mesh1", BASE))
    assert own_entries("b02", seen, Radios(frozenset({"mesh1"}))) == (StationEntry("b02", "mesh1", BASE),)
    assert own_entries("b02", seen, NO_RADIOS) == ()


@dataclass(frozen=True)
class Second:
    """What iw and batctl of a holder print about its neighbor within one second of its clock."""

    inactive_ms: int
    connected_s: int
    echo: str


ANSWERED = "20 bytes from 02:00:00:00:01:02 icmp_seq=1 ttl=50 time=1.10 ms"
LOST = "Reply from host 02:00:00:00:01:02 timed out"
UNREACHABLE = "From 02:00:00:00:01:02: Destination Host Unreachable (icmp_seq 1)"
# Tools of a holder: line N of `seconds` is what they print at second N; the clock is what sleeps. `del` writes down
# when it was called, and the entry is a new one from then on where `renews` is there.
FAKES = {
    "iw": """now=$(cat "$HERE/now")
[ $# != 1 ] || printf 'phy#0\\n\\tInterface mesh0\\nphy#1\\n\\tInterface mesh1\\n'
IFS='|' read -r inactive connected _ <<END
$(sed -n "${now}p" "$HERE/seconds")
END
[ ! -f "$HERE/renewed" ] || connected=0
case $4 in
get)
    [ -n "$inactive" ] || exit 0
    printf 'Station %s\\n\\tinactive time:\\t%s ms\\n' "$5" "$inactive"
    printf '\\tconnected time:\\t%s seconds\\n' "$connected"
    ;;
del) echo "$now $2 $5" >>"$HERE/deleted"; [ ! -f "$HERE/renews" ] || : >"$HERE/renewed"; [ "$5" != unknown ] ;;
esac""",
    "batctl": """echo "$@" >>"$HERE/asked"
[ "$3" != tg ] || { cat "$HERE/table" 2>/dev/null; exit 0; }
[ ! -f "$HERE/renewed" ] || { echo "20 bytes from x"; exit 0; }
if [ -f "$HERE/numbers" ] && [ "$(grep -c -- '-c 52 ' "$HERE/asked")" -ge "$(cat "$HERE/numbers")" ]; then
    echo "20 bytes from x"
    exit 0
fi
sed -n "$(cat "$HERE/now")s/.*|//p" "$HERE"/seconds
""",
    "sleep": """[ ! -f "$HERE/login" ] || until [ -f "$HERE/called" ]; do /bin/sleep 0.01; done
now=$(($(cat "$HERE/now") + $1)); echo $now >"$HERE/now"; echo $((1000 + now)).00 1.00 >"$HERE/uptime"
[ ! -f "$HERE/last.$now" ] || cp "$HERE/last.$now" "$HERE/memory/last"
""",
    # `login` is what the neighbor's dropbear says; then it waits, as dropbear does. A pause lasts until it has spoken
    "nc": """cat "$HERE/login" >&2; echo "$@" >"$HERE/called"; exec /bin/sleep 60""",
    "netstat": """cat "$HERE/connections" 2>/dev/null""",
    "start-stop-daemon": 'while [ "$1" != -- ]; do shift; done; shift; exec sh "$@"',
    "mkdir": ":",
    # so that pauses use `sleep`
    "mkfifo": "exit 1",
}


def deletions(place: Path, seconds: list[Second], text: str, *, bat: str = "bat0") -> tuple[str, list[str]]:
    """What a script prints on a holder whose tools print this, second by second, and what it deletes when."""
    for name, body in FAKES.items():
        (place / name).write_text(f"#!/bin/sh\n{body}\n", encoding="ascii")
        (place / name).chmod(0o755)
    (place / "now").write_text("1")
    (place / "uptime").write_text("1001.00 1.00")
    (place / "seconds").write_text("".join(f"{one.inactive_ms}|{one.connected_s}|{one.echo}\n" for one in seconds))
    if bat:
        (place / "net" / "mesh0").mkdir(parents=True, exist_ok=True)
        (place / "net" / bat).mkdir(exist_ok=True)
        (place / "net" / "mesh0" / "master").unlink(missing_ok=True)
        (place / "net" / "mesh0" / "master").symlink_to(f"../{bat}")
    text = text.replace("/sys/class/net", str(place / "net")).replace("/proc/uptime", str(place / "uptime"))
    text = text.replace("/tmp/meshctl", str(place / "memory")).replace("/proc/net/arp", str(place / "arp"))
    text = text.replace("/etc/meshctl/last", str(place / "memory" / "last"))
    environ = {"PATH": f"{place}:/usr/bin:/bin", "HERE": str(place)}
    done = subprocess.run(
        ("sh", "-c", text), env=environ, cwd=place, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.stderr == ""
    log = place / "deleted"
    return done.stdout, log.read_text().splitlines() if log.exists() else []


def flushed(place: Path, now: Second, *, bat: str = "bat0", has_restarted: bool = False) -> str:
    """What a holder with such an entry prints when it is queried for entries of at least 11.2 s."""
    text = flush_script([StationEntry("b01", "mesh0", MAC)], older_than_s=11.2, has_restarted=has_restarted)
    printed, deleted = deletions(place, [now], text, bat=bat)
    assert deleted == ([f"1 mesh0 {MAC}"] if printed == f"gone {MAC}\n" else [])
    return printed


@pytest.mark.parametrize(
    ("now", "printed"),
    [
        (Second(100, 50, LOST), f"gone {MAC}\n"),
        # it never restarted, or the neighbor has removed the stale entry already
        (Second(100, 50, ANSWERED), f"answers {MAC}\n"),
        # newer than the change
        (Second(100, 11, LOST), ""),
        # off the air: there is nothing to hear, so nothing is known to be dropped
        (Second(5000, 50, LOST), ""),
        # batman-adv has no path, which proves nothing about the link; nor does a tool without `ping`
        (Second(100, 50, UNREACHABLE), f"unknown {MAC}\n"),
        (Second(100, 50, "Error - unknown command: ping"), f"unknown {MAC}\n"),
    ],
)
def test_an_entry_is_removed_only_where_its_neighbor_is_heard_and_does_not_answer(
    tmp_path: Path, now: Second, printed: str
) -> None:
    assert flushed(tmp_path, now) == printed


def test_three_echo_requests_are_sent_before_an_entry_is_removed(tmp_path: Path) -> None:
    flushed(tmp_path, Second(100, 50, LOST))
    assert (tmp_path / "asked").read_text() == f"meshif bat0 ping -c 3 -t 1 {MAC}\n"


def test_the_batctl_syntax_of_openwrt_19_07_is_tried_as_a_fallback(tmp_path: Path) -> None:
    assert flushed(tmp_path, Second(100, 50, "Error - unknown command: meshif")) == f"unknown {MAC}\n"
    asked = (tmp_path / "asked").read_text().splitlines()
    assert asked == [f"{word} bat0 ping -c 3 -t 1 {MAC}" for word in ("meshif", "-m")]


def test_without_batman_adv_an_entry_is_removed_only_after_an_observed_restart(tmp_path: Path) -> None:
    assert flushed(tmp_path, Second(100, 50, LOST), bat="") == f"unknown {MAC}\n"
    assert flushed(tmp_path, Second(100, 50, ANSWERED), bat="", has_restarted=True) == f"gone {MAC}\n"


def test_an_entry_that_cannot_be_removed_is_reported(tmp_path: Path) -> None:
    text = flush_script([StationEntry("b01", "mesh0", "unknown")], older_than_s=1)
    assert deletions(tmp_path, [Second(100, 50, LOST)], text)[0] == "kept unknown\n"


def test_an_entry_without_a_known_interface_is_flushed_on_all_interfaces(tmp_path: Path) -> None:
    text = flush_script([StationEntry("b01", "", MAC)], older_than_s=11.2)
    printed, deleted = deletions(tmp_path, [Second(100, 50, LOST)], text)
    assert printed == f"gone {MAC}\n" * 2
    assert deleted == [f"1 mesh0 {MAC}", f"1 mesh1 {MAC}"]


# What busybox's netstat prints of the connection to the neighbor's dropbear, and /proc/net/arp of its address.
CONNECTION = "tcp        0      1 10.42.0.12:46772         10.42.0.11:22           %s\n"
OTHERS = "tcp        0      0 10.42.0.12:22            10.42.0.250:53124       ESTABLISHED\n"
KNOWN = "10.42.0.11       0x1         0x2         02:00:00:00:01:02     *        br-lan\n"
UNUSED = "10.42.0.11       0x1         0x0         00:00:00:00:00:00     *        br-lan\n"
SENT, OPEN = CONNECTION % "SYN_SENT", CONNECTION % "ESTABLISHED"


@pytest.mark.parametrize(
    ("login", "connections", "arp", "printed"),
    [
        # its SYN-ACK is dropped
        ("", OTHERS + SENT, KNOWN, f"gone {MAC}\n"),
        ("SSH-2.0-dropbear", OPEN, KNOWN, f"answers {MAC}\n"),
        # a firewall that rejects, or a server that is down
        ("nc: can't connect to remote host (10.42.0.11): Connection refused", "", KNOWN, f"answers {MAC}\n"),
        # a server that accepts and hangs, as one that waits for logd does
        ("", OPEN, KNOWN, f"answers {MAC}\n"),
        ("", CONNECTION % "FIN_WAIT2", KNOWN, f"answers {MAC}\n"),
        # no device has the address: the node does not have its configuration yet
        ("", SENT, UNUSED, f"answers {MAC}\n"),
        ("nc: can't connect to remote host (10.42.0.11): No route to host", OTHERS, "", f"answers {MAC}\n"),
    ],
)
def test_a_neighbor_that_answers_echo_requests_has_to_answer_logins_too(
    tmp_path: Path, login: str, connections: str, arp: str, printed: str
) -> None:
    """Seen on real OpenWrt: after a power cut every echo request was answered, and no login for four minutes."""
    (tmp_path / "login").write_text(login)
    (tmp_path / "connections").write_text(connections)
    (tmp_path / "arp").write_text(arp)
    (tmp_path / "memory").mkdir()
    text = flush_script([StationEntry("b01", "mesh0", MAC)], older_than_s=11.2, login=LoginPlace("10.42.0.11", 22))
    assert deletions(tmp_path, [Second(100, 50, ANSWERED)] * 9, text)[0] == printed
    assert (tmp_path / "called").read_text() == "10.42.0.11 22\n"
    assert list((tmp_path / "memory").iterdir()) == []


@pytest.mark.parametrize(("echo", "printed"), [(LOST, f"gone {MAC}\n"), (UNREACHABLE, f"unknown {MAC}\n")])
def test_no_login_is_tried_where_no_echo_request_is_answered(tmp_path: Path, echo: str, printed: str) -> None:
    text = flush_script([StationEntry("b01", "mesh0", MAC)], older_than_s=11.2, login=LoginPlace("10.42.0.11", 22))
    assert deletions(tmp_path, [Second(100, 50, echo)] * 9, text)[0] == printed
    assert not (tmp_path / "called").exists()


def test_without_nc_echo_requests_decide(tmp_path: Path) -> None:
    text = flush_script([StationEntry("b01", "mesh0", MAC)], older_than_s=11.2, login=LoginPlace("10.42.0.11", 22))
    # the host of the tests may have it
    text = text.replace("command -v nc", "command -v absent")
    assert deletions(tmp_path, [Second(100, 50, ANSWERED)], text)[0] == f"answers {MAC}\n"
    assert deletions(tmp_path, [Second(100, 50, LOST)], text)[0] == f"gone {MAC}\n"


def reconnected(place: Path, now: Second, *, numbers: int | None = None) -> list[str]:
    """What a holder prints whose neighbor drops its frames until so many senders have sent."""
    if numbers is not None:
        (place / "numbers").write_text(f"{numbers}")
    text = reconnect_script([StationEntry("b01", "mesh0", MAC)], caught_up=1, logins={})
    return deletions(place, [now] * 5, text)[0].splitlines()


def test_a_neighbor_that_drops_frames_until_their_numbers_catch_up_is_sent_enough(tmp_path: Path) -> None:
    """The holder's radio restarted, and the neighbor has the old entry; removing one's own entry is of no help."""
    assert reconnected(tmp_path, Second(100, 50, LOST), numbers=40) == [f"gone {MAC}", f"caught-up {MAC}"]
    sent = [line for line in (tmp_path / "asked").read_text().splitlines() if " -c 52 " in line]
    # 12 bits of numbers, of which the half that is behind the window is dropped
    assert sent == [f"meshif bat0 ping -i 0.01 -c 52 -t 1 {MAC}"] * 40
    assert len(sent) * 52 > 4096 / 2


def test_only_where_the_node_of_a_radio_is_known_its_ssh_server_is_tried() -> None:
    entries = [StationEntry("b01", "mesh0", MAC.upper()), StationEntry("b01", "mesh0", OTHER)]
    text = reconnect_script(entries, caught_up=0, logins={MAC: (LoginPlace("10.42.0.11", 2222),)})
    calls = [line for line in text.splitlines() if line.startswith("flush_stale ")]
    assert calls == [f"flush_stale mesh0 {MAC.upper()} 0 10.42.0.11 2222", f"flush_stale mesh0 {OTHER} 0"]


def test_a_neighbor_that_still_does_not_answer_is_sent_no_more(tmp_path: Path) -> None:
    assert reconnected(tmp_path, Second(100, 50, LOST), numbers=41) == [f"gone {MAC}", f"silent {MAC}"]


@pytest.mark.parametrize(
    ("now", "renews", "printed"),
    [
        (Second(100, 50, LOST), True, [f"gone {MAC}", f"answers {MAC}"]),
        (Second(100, 50, ANSWERED), False, [f"answers {MAC}"] * 2),
        (Second(5000, 50, LOST), False, []),
        (Second(100, 50, UNREACHABLE), False, [f"unknown {MAC}"] * 2),
    ],
)
def test_nothing_is_sent_to_a_neighbor_that_answers_or_is_not_heard(
    tmp_path: Path, now: Second, renews: bool, printed: list[str]
) -> None:
    if renews:
        (tmp_path / "renews").touch()
    assert reconnected(tmp_path, now) == printed
    assert not (tmp_path / "asked").exists() or " -c 52 " not in (tmp_path / "asked").read_text()


def watched(place: Path, seconds: list[Second], *, ends_when_confirmed: bool = False) -> list[int]:
    """When an entry like this is deleted by a holder that watches it."""
    entries = [StationEntry("b01", "mesh0", MAC)]
    text = watch_script("b02", entries, for_s=len(seconds), ends_when_confirmed=ends_when_confirmed)
    _, deleted = deletions(place, [*seconds, *seconds[-1:]], text)
    assert all(line.endswith(f" mesh0 {MAC}") for line in deleted)
    return [int(line.split()[0]) for line in deleted]


def test_the_entry_of_a_radio_that_keeps_answering_is_never_removed(tmp_path: Path) -> None:
    assert watched(tmp_path, [Second(100, 500 + at, ANSWERED) for at in range(65)]) == []


def test_a_radio_heard_again_without_answering_has_its_entry_removed_once(tmp_path: Path) -> None:
    (tmp_path / "renews").touch()
    away = [Second(1000 * at, 500 + at, LOST) for at in range(2, 20)]
    back = [Second(100, 520 + at, LOST) for at in range(40)]
    (when,) = watched(tmp_path, [Second(100, 500, ANSWERED), *away, *back])
    assert len(away) < when <= len(away) + 5


def test_a_radio_that_comes_back_as_a_new_station_is_left_alone(tmp_path: Path) -> None:
    away = [Second(1000 * at, 500 + at, LOST) for at in range(2, 20)]
    assert watched(tmp_path, [*away, *(Second(100, at, LOST) for at in range(40))]) == []


def test_an_ineffective_removal_is_attempted_at_most_three_times(tmp_path: Path) -> None:
    assert len(watched(tmp_path, [Second(100, 500 + at, LOST) for at in range(60)])) == 3


@pytest.mark.parametrize(
    ("outcome", "ends_when_confirmed", "is_short"),
    [("confirmed", True, True), ("restored", True, False), ("confirmed", False, False)],
)
def test_a_nodes_own_watch_ends_soon_after_its_change_is_confirmed(
    tmp_path: Path, outcome: str, ends_when_confirmed: bool, is_short: bool
) -> None:
    """On 25.12 userspace, it started two processes every two seconds for two minutes after the confirmation."""
    last = tmp_path / "memory" / "last"
    last.parent.mkdir()
    last.write_text("c1 confirmed operator 00\n")
    (tmp_path / "last.11").write_text(f"c2 {outcome} operator 00\n")
    watched(tmp_path, [Second(100, 500 + at, ANSWERED) for at in range(100)], ends_when_confirmed=ends_when_confirmed)
    looks_end_s = int((tmp_path / "now").read_text())
    assert (looks_end_s < 45) is is_short


def test_a_watch_leaves_no_file_behind_and_replaces_only_a_watch(tmp_path: Path) -> None:
    (tmp_path / "memory").mkdir()
    number = tmp_path / "memory" / "forget.b02.pid"
    sleeping = [sys.executable, "-c", "import time; time.sleep(600)"]
    for words, is_watch in ((["watch_stale"], True), (["something else"], False)):
        with subprocess.Popen([*sleeping, *words]) as process:
            # of a watch that was killed, its number is another process's by now
            number.write_text(f"{process.pid}\n")
            try:
                watched(tmp_path, [Second(100, 500 + at, ANSWERED) for at in range(5)])
                if is_watch:
                    assert process.wait(60) == -signal.SIGTERM
                else:
                    assert process.poll() is None
            finally:
                process.kill()
        assert list((tmp_path / "memory").iterdir()) == []


def test_values_reported_by_a_node_are_never_executed_by_the_shell(tmp_path: Path) -> None:
    evil = [StationEntry("b01", "mesh0; touch x", "$(touch x)"), StationEntry("b01", "'; touch x; '", "`touch x`")]
    for has_restarted in (False, True):
        text = flush_script(evil, older_than_s=1, has_restarted=has_restarted) + watch_script("b02", evil, for_s=4)
        text += reconnect_script(evil, caught_up=1, logins={})
        deletions(tmp_path, [Second(100, 5000, LOST)] * 9, text)
        assert (tmp_path / "deleted").exists()
        assert not (tmp_path / "x").exists()
