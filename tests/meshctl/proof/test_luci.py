"""LuCI's "Save & Apply" before and inside a change's window: the node ends with what meshctl said of it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from meshctl.model import Release
from meshlab.fleet import VirtualNode
from meshlab.spec import MESH_PACKAGES
from tests.meshctl.proof.rig import Rig
from tests.meshlab.luci import SNAPSHOT, await_rollback, edit, log_in, save_and_apply
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("luci")]

WINDOW_S = 60
NAME = "n001"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    packages = (*MESH_PACKAGES, "rpcd")
    place: Path = tmp_path_factory.mktemp("luci")
    with Rig(place, 1, window_s=WINDOW_S, packages=packages, release=Release.V25_12) as made:
        assert made.take_in(made.current).code == 0
        yield made


def edited(rig: Rig, package: str = "system", option: str = "description") -> tuple[VirtualNode, str]:
    """The node, and a session of LuCI's with a change of that package."""
    node = rig.fleet.node(NAME)
    session = log_in(node)
    section = node.exec(f"uci -X show {package} | sed -n '1s/=.*//p'").stdout.strip().partition(".")[2]
    edit(node, session, package, section, **{option: "by LuCI"})
    return node, session


def apply_in_the_window(rig: Rig, variant: str, package: str, option: str, *, rollback_s: int) -> dict[str, str]:
    """meshctl's results for a change in whose window LuCI applies one of its own: meshctl is stopped meanwhile."""
    node, session = edited(rig, package, option)
    with rig.start("provision", variant, NAME, "--yes", "--json") as process:
        until(lambda: " state=applied " in node.exec("meshctl-deadman status").stdout, "the window", wait_s=300.0)
        process.send_signal(signal.SIGSTOP)
        save_and_apply(node, session, rollback_s=rollback_s)
        process.send_signal(signal.SIGCONT)
        out, err = process.communicate(timeout=600)
    assert '"ended"' in out, out + err
    (ended,) = [line for line in out.splitlines() if '"event": "ended"' in line]
    return {NAME: "done" if '"result": "done"' in ended else "rolled back" if '"rolled back"' in ended else ended}


def test_a_change_is_refused_while_luci_waits_and_made_once_it_has_gone_back(rig: Rig) -> None:
    old, new = rig.flip()
    node, session = edited(rig)
    save_and_apply(node, session, rollback_s=45)
    refused = rig.meshctl("provision", new, NAME, "--yes", "--json")
    assert refused.results == {NAME: "refused"}, refused.out + refused.err
    assert "rpcd waits for the confirmation of a change to system" in refused.out
    planned = rig.meshctl("plan", new, NAME)
    assert (planned.code, "rpcd waits for the confirmation of a change to system" in planned.out) == (1, True)
    await_rollback(node)
    assert rig.state_of(NAME, old, new) == "old"
    done = rig.meshctl("provision", new, NAME, "--yes", "--json")
    assert done.results == {NAME: "done"}, done.out + done.err
    assert rig.state_of(NAME, old, new) == "new"


def test_an_unchecked_apply_stops_no_change(rig: Rig) -> None:
    old, new = rig.flip()
    node, session = edited(rig)
    save_and_apply(node, session, rollback_s=None)
    done = rig.meshctl("provision", new, NAME, "--yes", "--json")
    assert done.results == {NAME: "done"}, done.out + done.err
    assert rig.state_of(NAME, old, new) == "new"
    assert "system" in node.exec(f"ls {SNAPSHOT}").stdout.split()


def test_what_is_confirmed_stays_although_luci_goes_back_later(rig: Rig) -> None:
    old, new = rig.flip()
    results = apply_in_the_window(rig, new, "system", "description", rollback_s=30)
    assert results == {NAME: "done"}
    await_rollback(rig.fleet.node(NAME))
    assert rig.state_of(NAME, old, new) == "new"


def test_what_was_rolled_back_does_not_return_with_lucis_way_back(rig: Rig) -> None:
    """Seen on 25.12.5: 45 s after the rollback, the REJECT that had locked the operators out was back."""
    current = rig.current
    other = "b" if current == "a" else "a"
    text = rig.inventory(other).read_text(encoding="utf-8")
    locked = text.replace("defaults: {", "defaults: {extra_uci: {firewall.management.input: REJECT}, ")
    rig.inventory("locked").write_text(locked, encoding="utf-8")
    results = apply_in_the_window(rig, "locked", "firewall", "drop_invalid", rollback_s=WINDOW_S + 30)
    assert results == {NAME: "rolled back"}
    await_rollback(rig.fleet.node(NAME))
    assert rig.state_of(NAME, current, other) == "old"
    assert "REJECT" not in rig.fleet.node(NAME).exec("uci show firewall.management").stdout
    checked = rig.meshctl("provision", current, "--check", "--json")
    assert checked.verdicts[NAME] == "same", checked.out
