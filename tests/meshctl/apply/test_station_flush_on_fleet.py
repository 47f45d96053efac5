"""Stale station entries of a virtual fleet: neighbors of nodes whose radios restart remove them."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator

import pytest

from meshctl.apply.reconnect import HEARD_MS
from meshctl.model import Release
from meshctl.plan.radios import SLACK_S
from meshlab.fleet import VirtualNode
from tests import waiting
from tests.meshctl.proof.rig import Ended, Rig


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    # its radios keep their address when they restart
    with Rig(tmp_path_factory.mktemp("rig"), count=1, window_s=60, release=Release.V22_03) as made:
        made.take_in(made.current)
        yield made


def notes(ended: Ended) -> list[str]:
    """The notes about the node's radio."""
    events = [event for event in ended.events if event["event"] == "note" and event["node"] == "n001"]
    return [event["text"] for event in events if "its radio" in event["text"]]


def known_for_s(rig: Rig) -> list[int]:
    """For how many seconds base has known each radio that it hears."""
    dump = rig.fleet.node("base").exec("iw dev mesh0 station dump").check("base: stations").stdout
    return [int(age) for age in re.findall(r"connected time:\s*(\d+)", dump)]


def is_heard(rig: Rig) -> bool:
    """Whether base hears the only other radio now."""
    dump = rig.fleet.node("base").exec("iw dev mesh0 station dump").check("base: stations").stdout
    return any(int(age_ms) < HEARD_MS for age_ms in re.findall(r"inactive time:\s*(\d+)", dump))


def is_set_up(node: VirtualNode, *, distance: int) -> bool:
    """Whether netifd has set the node's radio up with this distance."""
    status = node.exec("ubus call network.wireless status").stdout
    if not status.strip():
        # netifd is replacing its program
        return False
    radio = json.loads(status)["radio0"]
    return radio["up"] and not radio["pending"] and int(radio["config"]["distance"]) == distance


FLUSHED = ["base removed a stale entry of its radio"]


@pytest.mark.lab
@pytest.mark.xdist_group("stations")
class TestOnAVirtualFleet:
    """The same over real SSH; each test leaves the fleet on the rig's current inventory."""

    def test_after_a_radio_change_the_neighbor_has_flushed_its_entry(self, rig: Rig) -> None:
        _, new = rig.flip()
        ended = rig.meshctl("provision", new, "n001", "--yes", "--json")
        assert ended.results == {"n001": "done"}, ended.out + ended.err
        assert notes(ended) == FLUSHED

    def test_a_change_outside_the_wireless_config_flushes_no_entries(self, rig: Rig) -> None:
        text = rig.inventory(rig.current).read_text(encoding="utf-8")
        assert text.count("hop_penalty: 3") == 1
        rig.inventory("penalty").write_text(text.replace("hop_penalty: 3", "hop_penalty: 4"), encoding="utf-8")
        for variant in ("penalty", rig.current):
            ended = rig.meshctl("provision", variant, "n001", "--yes", "--json")
            assert ended.results == {"n001": "done"}, ended.out + ended.err
            assert notes(ended) == []
            assert not [event for event in ended.events if event.get("text") == "flush neighbor station entries"]

    def test_the_neighbor_of_a_restored_node_flushes_its_entry(self, rig: Rig) -> None:
        folder = rig.directory / "backups"
        assert rig.meshctl("backup", rig.current, "n001", "--out", str(folder)).code == 0
        (file,) = folder.iterdir()
        node = rig.fleet.node("n001")
        node.exec("uci set wireless.radio0.distance=777 && uci commit wireless && reload_config").check("edit by hand")
        waiting.until(lambda: is_set_up(node, distance=777), "its radio to be set up with the edit")
        restored = rig.meshctl("restore", rig.current, "n001", str(file), "--yes", "--json")
        assert restored.code == 0, restored.out + restored.err
        assert notes(restored) == FLUSHED
        assert rig.state_of("n001", "split", rig.current) == "new"

    def test_an_unreachable_neighbor_is_reported_unless_a_retry_succeeds(self, rig: Rig) -> None:
        # its host key is not the pinned one, so it is not queried until that is resolved
        rig.fleet.inject_fault("base", "host-key")
        _, new = rig.flip()
        ended = rig.meshctl("provision", new, "n001", "--yes", "--json")
        assert ended.results == {"n001": "done"}, ended.out + ended.err
        assert notes(ended) == [
            "base did not answer and may hold a stale entry of its radio: "
            "unicast frames to them may be lost for minutes"
        ]
        assert ended.events[-1]["outcomes"][0]["facts"] == {"not_asked": "base"}
        _, new = rig.flip()
        said: list[str] = []
        with rig.start("provision", new, "n001", "--yes", "--json") as process:
            assert process.stdout is not None
            for line in process.stdout:
                said.append(line)
                if json.loads(line).get("text") == "apply":
                    # on a busy machine the run would end before the other command has
                    process.send_signal(signal.SIGSTOP)
                    assert rig.meshctl("trust", new, "base", "--replace", "--yes").code == 0
                    process.send_signal(signal.SIGCONT)
                    break
            rest, err = process.communicate()
        ended = Ended(process.returncode, "".join(said) + rest, err)
        assert ended.results == {"n001": "done"}, ended.out + ended.err
        assert notes(ended) == FLUSHED

    def test_after_a_reboot_the_next_run_flushes_the_neighbors_entry_once(self, rig: Rig) -> None:
        boot = rig.fleet.node("n001").boot_id
        waiting.until(lambda: max(known_for_s(rig), default=0) > SLACK_S + 2, "base to know the radio for a while")
        rig.meshctl("run", rig.current, "n001", command=["reboot"])
        waiting.until(lambda: rig.fleet.node("n001").boot_id != boot, "the node to boot")
        rig.fleet.node("n001").wait_up(wait_s=120.0)
        waiting.until(lambda: bool(known_for_s(rig)), "its radio to be heard again")
        for expected in (FLUSHED, []):
            ended = rig.meshctl("provision", rig.current, "--yes", "--json")
            assert ended.results["n001"] == "unchanged", ended.out + ended.err
            assert notes(ended) == expected

    def test_a_node_that_is_unreachable_since_its_power_was_cut_is_reached_and_changed(self, rig: Rig) -> None:
        node = rig.fleet.node("n001")
        boot = node.boot_id
        waiting.until(lambda: max(known_for_s(rig), default=0) > SLACK_S + 2, "base to know the radio for a while")
        rig.fleet.inject_fault("n001", "power-cut")
        waiting.until(lambda: node.boot_id != boot, "the node to boot")
        node.wait_up(wait_s=120.0)
        waiting.until(lambda: is_heard(rig), "base to hear its radio again")
        # over the mesh alone
        node.plug(False)
        try:
            assert rig.meshctl("provision", rig.current, "n001", "--check", "--json").verdicts["n001"] == "away"
            _, new = rig.flip()
            ended = rig.meshctl("provision", new, "n001", "--yes", "--json")
            assert ended.results == {"n001": "done"}, ended.out + ended.err
        finally:
            node.plug(True)

    def test_a_node_whose_power_is_cut_before_its_change_is_armed_is_reached_and_changed(self, rig: Rig) -> None:
        node = rig.fleet.node("n001")
        waiting.until(lambda: max(known_for_s(rig), default=0) > SLACK_S + 2, "base to know the radio for a while")
        text = rig.inventory(rig.current).read_text(encoding="utf-8")
        rig.inventory("penalty").write_text(text.replace("hop_penalty: 3", "hop_penalty: 4"), encoding="utf-8")
        # over the mesh alone
        node.plug(False)
        try:
            rig.fleet.inject_fault("n001", "power-cut@tar -xzf")
            # with a limited rate the steps are commands of their own
            ended = rig.meshctl("provision", "penalty", "n001", "--rate", "1000", "--yes", "--json")
            assert ended.results == {"n001": "done"}, ended.out + ended.err
            assert notes(ended) == FLUSHED
        finally:
            node.plug(True)
        assert rig.meshctl("provision", rig.current, "n001", "--yes", "--json").results == {"n001": "done"}

    def test_an_unobserved_radio_restart_is_flushed_later(self, rig: Rig) -> None:
        old, new = rig.current, {"a": "b", "b": "a"}[rig.current]
        boot = rig.fleet.node("n001").boot_id
        waiting.until(lambda: max(known_for_s(rig), default=0) > SLACK_S + 2, "base to know the radio for a while")
        with rig.start("provision", new, "n001", "--yes", "--json") as process:
            assert process.stdout is not None
            for line in process.stdout:
                if json.loads(line).get("text") == "prove":
                    process.send_signal(signal.SIGKILL)
                    break
        rig.fleet.inject_fault("n001", "power-cut")
        waiting.until(lambda: rig.fleet.node("n001").boot_id != boot, "the node to boot")
        rig.fleet.node("n001").wait_up(wait_s=120.0)
        waiting.until(lambda: bool(known_for_s(rig)), "its radio to be heard again")
        ended = rig.meshctl("provision", old, "n001", "--yes", "--json")
        assert ended.results == {"n001": "unchanged"}, ended.out + ended.err
        assert notes(ended) == FLUSHED
        again = rig.meshctl("provision", old, "n001", "--yes", "--json")
        assert (again.results, notes(again)) == ({"n001": "unchanged"}, [])
