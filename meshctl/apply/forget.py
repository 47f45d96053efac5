"""Have a node's neighbours forget its radio when it starts anew, so that they take its frames again.

A radio that starts anew counts its frames from 0. A neighbour goes on with the block acknowledgement window it had and
drops that node's unicast until the numbers have caught up, while broadcasts pass and batman-adv sees a perfect link
(docs/lab.md). Without its station entry it learns the node anew from the next beacon. To forget a node that did *not*
start anew does the same harm the other way round, because the neighbour then counts from 0: so each forgets once.

    observations -> who holds an entry of the node's radios (`entries_of`), and whose way leads through it (`behind`)
    before the radio goes: those behind it are started to watch it and to forget it by themselves (`watch_script`)
    silence -> whether to ask the others by now, sparingly (`next_ask_s`), to forget what is older (`forget_script`)
    -> those that can be reached are asked, all at once, each within `ASK_S` (`Forgetting`) -> one line of what they did

Nothing here is a reason for failure: a neighbour that does not answer, or cannot (19.07), changes no outcome.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field

from meshctl.apply.job import Job
from meshctl.device.connection import Deadlines
from meshctl.device.framing import quoted
from meshctl.device.observation import Observation
from meshctl.errors import NodeError
from meshctl.topology import mesh_macs

# A neighbour's answer; over a kept connection it takes a round trip.
ASK_S = 8.0
# It is no disaster when one cannot be asked, so a new connection may take less time than elsewhere.
_DEADLINES = Deadlines(connect_s=5.0, handshake_s=10.0, auth_s=10.0, channel_s=ASK_S, run_s=ASK_S, silence_s=ASK_S)
# Asked too early, while the old radio still sends, an entry comes back as it was; asked too late, when the node is
# behind another neighbour by then, nobody is there to ask: so they are asked again while the node is silent, after the
# first pause, then after twice as long each time. A minute is the longest, because that long an ad-hoc cell of Linux
# remembers whom it does not hear (IEEE80211_IBSS_INACTIVITY_LIMIT, net/mac80211/ibss.c).
FIRST_PAUSE_S, LONGEST_PAUSE_S = 10.0, 60.0
# A node whose connection is not there by then is silent: an SSH login takes a board two seconds.
SILENT_S = 5.0
# Who watches looks once a second. At first a radio that starts anew is expected, so a short silence is taken for it; a
# neighbour is heard several times a second (beacons, batman-adv's OGMs and those it repeats). If there was none, the
# radio was quicker than that. Later (it goes back, or reboots) only a silence that no bad link makes.
EXPECTED_S, EXPECTED_SILENCE_MS, LATER_SILENCE_MS = 30, 1000, 3000
# More neighbours than any radio here has; bounds what a hostile station table costs.
MOST_ASKED = 16


@dataclass(frozen=True, slots=True)
class Entry:
    """A station entry: node `holder` knows the radio `mac` on its interface `ifname`."""

    holder: str
    ifname: str
    mac: str


def entries_of(node: str, around: Mapping[str, Observation]) -> tuple[Entry, ...]:
    """Who of those observed holds a station entry of `node`'s mesh radios, in the order of `around`."""
    if node not in around:
        return ()
    macs = frozenset(mesh_macs(around[node]))
    return tuple(
        Entry(holder, station.ifname, station.mac)
        for holder, seen in around.items()
        if holder != node
        for station in seen.stations or ()
        if station.mac.lower() in macs
    )


def by_holder(entries: Iterable[Entry]) -> dict[str, tuple[Entry, ...]]:
    """The entries of each holder, of the first `MOST_ASKED` ones."""
    grouped: dict[str, tuple[Entry, ...]] = {}
    for entry in entries:
        grouped[entry.holder] = (*grouped.get(entry.holder, ()), entry)
    return dict(list(grouped.items())[:MOST_ASKED])


def behind(node: str, around: Mapping[str, Observation], base_macs: Iterable[str]) -> frozenset[str]:
    """The nodes whose best way to the base leads through `node` first: while it is not heard, they are out of reach."""
    if node not in around:
        return frozenset()
    own, bases = frozenset(mesh_macs(around[node])), frozenset(mac.lower() for mac in base_macs)
    return frozenset(
        name
        for name, seen in around.items()
        for entry in seen.originators or ()
        if name != node and entry.best and entry.mac.lower() in bases and entry.next_hop.lower() in own
    )


def forget_script(entries: Iterable[Entry], *, older_than_s: float) -> str:
    """POSIX sh that removes those of a holder's entries that were made before the radio started anew, so long ago; each
    line that it prints is of one that was removed."""
    return "".join(
        f"age=$({_told(entry, 'connected time')}); "
        f'[ "${{age:-0}}" -ge {math.ceil(older_than_s)} ] && iw dev {_named(entry, "del")} 2>/dev/null && '
        f"echo {quoted(entry.mac)}\n"
        for entry in entries
    )


def watch_script(node: str, entries: Iterable[Entry], *, for_s: float) -> str:
    """POSIX sh that starts a process of the holder's own, which removes each entry when it falls silent, `for_s` long.

    It takes the place of one that watches `node` already.
    """
    steps = []
    for number, entry in enumerate(entries):
        steps += [
            f"age=$({_told(entry, 'inactive time')})",
            f'if [ "${{age:-0}}" -ge $limit ] || [ "$late/$did{number}" = 1/ ]; '
            f"then iw dev {_named(entry, 'del')}; did{number}=1; fi",
        ]
    firsts = " ".join(f"did{number}=" for number in range(len(steps) // 2))
    loop = "; ".join(
        (
            f"{firsts} at=0",
            f"while [ $at -lt {math.ceil(for_s)} ]",
            f"do sleep 1; at=$((at + 1)) late= limit={EXPECTED_SILENCE_MS}",
            f"[ $at -lt {EXPECTED_S} ] || limit={LATER_SILENCE_MS}",
            f"[ $at != {EXPECTED_S} ] || late=1",
            *steps,
            "done",
        )
    )
    pid_file = quoted(f"/tmp/meshctl/forget.{node}.pid")
    return (
        f"mkdir -p /tmp/meshctl; [ ! -f {pid_file} ] || kill $(cat {pid_file}) 2>/dev/null; rm -f {pid_file}\n"
        f"start-stop-daemon -S -q -b -m -p {pid_file} -x /bin/sh -- -c {quoted(loop)} && echo watching\n"
    )


def _named(entry: Entry, act: str) -> str:
    return f"{quoted(entry.ifname)} station {act} {quoted(entry.mac)}"


def _told(entry: Entry, word: str) -> str:
    """POSIX sh that prints the number iw has behind `word`."""
    return f"iw dev {_named(entry, 'get')} 2>/dev/null | sed -n 's/.*{word}:[^0-9]*\\([0-9]*\\).*/\\1/p'"


def next_ask_s(asked_s: Sequence[float]) -> float:
    """When those around a silent node are asked next, after they were at `asked_s` (seconds of one clock)."""
    if not asked_s:
        return float("-inf")
    pause_s: float = FIRST_PAUSE_S * 2 ** (len(asked_s) - 1)
    return asked_s[-1] + min(pause_s, LONGEST_PAUSE_S)


@dataclass(slots=True)
class Forgetting:
    """What has been asked of the neighbours of one node since its radio was about to start anew."""

    job: Job
    _holders: dict[str, tuple[Entry, ...]] = field(init=False, repr=False)
    # those who do it by themselves, and may not be reached while the node is silent
    _watching: frozenset[str] = frozenset()
    _asked_s: list[float] = field(default_factory=list)
    # what has been told: a node that is flashed is silent for minutes, and asked about again and again
    _told_steps: set[str] = field(default_factory=set)
    _told_names: set[str] = field(default_factory=set)
    # since when its radio may have started anew: for the first time, and because it went back
    _began_s: float | None = None
    _kept_until_s: float | None = None

    def __post_init__(self) -> None:
        self._holders = by_holder(entries_of(self.job.name, self.job.work.around))

    def beforehand(self, *, for_s: float) -> None:
        """Have those behind the node watch it; call it while the node still carries their frames."""
        own = self.job
        hidden = behind(own.name, own.work.around, own.expected.bases)
        names = [name for name in self._holders if name in hidden]
        watching = self._ask(
            "neighbours watch it", {name: watch_script(own.name, self._holders[name], for_s=for_s) for name in names}
        )
        self._watching = frozenset(watching)
        unwatched = [name for name in names if name not in watching]
        if unwatched:
            own.work.note(f"{_listed(unwatched)} could not be told that its radio starts anew", own.name)

    def begins(self) -> None:
        """From now on its radio may start anew."""
        self._began_s = time.monotonic()

    def stands(self) -> None:
        """It answers, and has not gone back yet."""
        self._kept_until_s = time.monotonic()

    @contextmanager
    def beside(self) -> Iterator[None]:
        """Ask beside what is tried meanwhile, if that takes so long that the node must be silent."""
        timer = threading.Timer(SILENT_S, self.while_silent)
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            timer.join()

    def while_silent(self, among: Container[str] | None = None) -> None:
        """Ask if it is time to; call it whenever the node did not answer. `among`: only these can be reached."""
        now_s = time.monotonic()
        if self._began_s is None or now_s < next_ask_s(self._asked_s):
            return
        names = [name for name in self._holders if name not in self._watching and (among is None or name in among)]
        if names:
            self._asked_s.append(now_s)
            self._forget(names, self._began_s)

    def when_back(self, *, went_back: bool) -> None:
        """Ask all that do not watch, once the node answers for good."""
        since_s = self._kept_until_s if went_back and self._kept_until_s is not None else self._began_s
        if since_s is not None:
            self._forget([name for name in self._holders if name not in self._watching], since_s)

    def _forget(self, names: Iterable[str], since_s: float) -> None:
        age_s = time.monotonic() - since_s
        scripts = {name: forget_script(self._holders[name], older_than_s=age_s) for name in names}
        did = self._ask("neighbours forget it", scripts)
        news = [name for name in did if name not in self._told_names]
        if news:
            self._told_names.update(news)
            self.job.work.note(f"{_listed(news)} forgot its radio, to hear it anew", self.job.name)

    def _ask(self, step: str, scripts: Mapping[str, str]) -> tuple[str, ...]:
        """Run each node's script, all at once; the names of those that printed something. The step is told once."""
        if not scripts or self.job.work.interrupt.leaving:
            return ()
        telling = nullcontext() if step in self._told_steps else self.job.step(step)
        self._told_steps.add(step)
        with (
            telling,
            ThreadPoolExecutor(max_workers=len(scripts), thread_name_prefix="forget") as pool,
        ):
            answers = pool.map(self._ask_one, scripts, scripts.values())
            return tuple(name for name, did in zip(scripts, answers, strict=True) if did)

    def _ask_one(self, name: str, script: str) -> bool:
        access = self.job.work.access
        try:
            connection = access.take(name) or access.open(self.job.work.fleet.nodes[name], deadlines=_DEADLINES)
        except NodeError:
            return False
        # a kept connection has longer deadlines of its own, and may lead through the very node that is silent
        patience = threading.Timer(ASK_S, connection.close)
        patience.daemon = True
        patience.start()
        try:
            done = connection.run(script, timeout_s=ASK_S)
        except NodeError:
            connection.close()
            return False
        finally:
            patience.cancel()
            access.keep(name, connection)
        return bool(done.stdout.strip())


def _listed(names: Sequence[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
