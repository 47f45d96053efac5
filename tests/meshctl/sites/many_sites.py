"""The show of many sites: their plans are ordered while uplinks come and go, and every outcome must be right."""

from __future__ import annotations

import json
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.meshctl.sites.nats_rig import NatsRig
from tests.meshctl.sites.recorded_site import changes_of, expected_result
from tests.waiting import until

# How long an uplink is there, and away.
UP_S, DOWN_S = (5.0, 20.0), (1.0, 8.0)


@dataclass(frozen=True, slots=True)
class Ended:
    """How the show ended: outcomes by result, the number of cuts, and of commands until all was known."""

    outcomes: Counter[str]
    cuts: int
    resumes: int
    seconds: float


def run_show(rig: NatsRig, seed: int, *, wait_s: float) -> Ended:
    """Plan all sites, take some offline, order all, cut uplinks at random, and resume until every outcome is known.

    Raises AssertionError for a wrong outcome: one that is not what happened at the site, a node that was changed twice,
    a run that was executed twice.
    """
    rng = random.Random(seed)
    power_dbm = str(rig.change_power())
    file = rig.directory / "plan.json"
    until(lambda: _plans_all(rig, file), "the plans of all sites", wait_s=wait_s)
    offline = rng.sample(sorted(rig.nodes), max(1, len(rig.nodes) // 8))
    for site in offline:
        rig.uplinks[site].cut()
    began_s = time.monotonic()
    with cutting(rig, [site for site in rig.nodes if site not in offline], rng) as cuts:
        ordered = rig.run("apply", str(file), "--json")
        assert ordered.code in (0, 1, 3), ordered
        for site in offline:
            rig.uplinks[site].mend()
        run = json.loads(rig.run("history", "--json", expected=0).out)[0]["run"]
        resumes = 0
        until(lambda: all(_runs(rig, site) == ["over"] for site in rig.nodes), "the runs of all sites", wait_s=wait_s)
        while not _knows_all(rig, run):
            assert time.monotonic() - began_s < wait_s, "the operator does not get to know how the runs ended"
            rig.run("resume", str(run), "--yes", "--json")
            resumes += 1
    outcomes = _outcomes(rig, run)
    _check(rig, outcomes, power_dbm)
    return Ended(Counter(outcomes.values()), len(cuts), resumes, time.monotonic() - began_s)


def _plans_all(rig: NatsRig, file: Path) -> bool:
    """Whether every site has planned; nodes among them are refused, so that `plan` exits with 1."""
    if rig.run("plan", "--out", str(file), "--brief").code not in (0, 1):
        return False
    return not any("error" in site for site in json.loads(file.read_text(encoding="utf-8"))["sites"].values())


def _runs(rig: NatsRig, site: str) -> list[str]:
    """The states of the runs that the site was ordered."""
    states = (state.state for state in rig.directory_of(site).runs())
    return [state for state in states if state != "prepared"]


def _outcomes(rig: NatsRig, run: int) -> dict[str, str]:
    found = json.loads(rig.run("history", str(run), "--json", expected=0).out)["outcomes"]
    return {outcome["node"]: outcome["result"] for outcome in found}


def _knows_all(rig: NatsRig, run: int) -> bool:
    return "pending" not in _outcomes(rig, run).values()


def _check(rig: NatsRig, outcomes: Mapping[str, str], power_dbm: str) -> None:
    for site, nodes in rig.nodes.items():
        at_site = _outcomes_at(rig.site_directory(site))
        found = {name: outcomes[name] for name in nodes}
        assert found == at_site, f"{site}: {sorted(found.items() ^ at_site.items())}"
    for site, nodes in rig.recorded.items():
        state = rig.directory_of(site).state
        for name in nodes:
            if name in rig.virtual:
                continue
            result = expected_result(name)
            assert (outcomes[name], changes_of(state, name)) == (result, [power_dbm] if result == "done" else []), name
    if rig.real:
        assert {outcomes[name] for name in rig.virtual} == {"done"}
        assert set(rig.powers(rig.virtual).values()) == {power_dbm}


def _outcomes_at(site: Path) -> dict[str, str]:
    """The last outcome of each node at a site; `resume` orders another run for those that have failed."""
    found: dict[str, str] = {}
    for order in sorted(site.glob("runs/*/order.json"), key=lambda path: path.stat().st_mtime):
        last = json.loads(order.with_name("events").read_text().splitlines()[-1])
        found |= {outcome["node"]: outcome["result"] for outcome in last["outcomes"]}
    return found


@contextmanager
def cutting(rig: NatsRig, sites: list[str], rng: random.Random) -> Iterator[list[str]]:
    """Cut the uplinks of these sites at random while the block runs; yields the sites that were cut, in order."""
    cuts: list[str] = []
    done = threading.Event()

    def cut() -> None:
        next_s = {site: time.monotonic() + rng.uniform(*UP_S) for site in sites}
        is_up = dict.fromkeys(sites, True)
        while not done.wait(0.1):
            for site in sites:
                if time.monotonic() < next_s[site]:
                    continue
                is_up[site] = not is_up[site]
                if is_up[site]:
                    rig.uplinks[site].mend()
                else:
                    rig.uplinks[site].cut()
                    cuts.append(site)
                next_s[site] = time.monotonic() + rng.uniform(*(UP_S if is_up[site] else DOWN_S))

    cutter = threading.Thread(target=cut)
    cutter.start()
    try:
        yield cuts
    finally:
        done.set()
        cutter.join()
        for site in sites:
            rig.uplinks[site].mend()


def main() -> None:
    """`python -m tests.meshctl.sites.many_sites SITES NODES_EACH [VIRTUAL_BASES [SEED]]`: the show. Two sites have
    virtual nodes alone, the others recorded nodes; all of these, or VIRTUAL_BASES of them, have a virtual base."""
    sites, nodes, *others = map(int, sys.argv[1:])
    virtual_bases, seed = (*others, *(sites, 1)[len(others) :])
    recorded = {f"s{number:02}": nodes for number in range(1, sites - 1)}
    with (
        tempfile.TemporaryDirectory(prefix="sites-") as scratch,
        NatsRig(Path(scratch), recorded, virtual_bases=virtual_bases) as rig,
    ):
        sys.stdout.write(f"{len(rig.virtual)} virtual nodes are set up\n")
        sys.stdout.flush()
        ended = run_show(rig, seed, wait_s=2400)
    counted = ", ".join(f"{count} {result}" for result, count in ended.outcomes.most_common())
    sys.stdout.write(
        f"{sites} sites: {counted}; {ended.cuts} cuts, {ended.resumes} times resumed, {ended.seconds:.0f} s\n"
    )


if __name__ == "__main__":
    main()
