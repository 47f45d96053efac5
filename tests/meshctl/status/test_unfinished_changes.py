"""A node that does not answer while it is changed or flashed is to be left on."""

from __future__ import annotations

from pathlib import Path

from meshctl.fleet import Outcome, Result
from meshctl.fleet.journal import Journal
from meshctl.status.unfinished_changes import waiting_hints
from meshctl.status.unreachable import no_answer_alarm
from meshctl.status.values import NoAnswer
from meshctl.topology import Sighting
from tests.meshctl.plan.support import fleet


def test_a_node_in_a_flash_is_to_be_left_on_and_one_that_rolls_back_to_be_waited_for(tmp_path: Path) -> None:
    team = fleet()
    with Journal(tmp_path / "journal.sqlite") as journal:
        run = journal.begin("provision", fleet=team.name, inventory="/x", nodes=("b01", "b02", "b03"))
        for name, step in (("b01", "apply"), ("b02", "flash"), ("b03", "flash")):
            with run.step(name, step):
                pass
        run.finish_node(Outcome("b03", Result.DONE))
        began_s = journal.steps(run.id, "b02")[0].began_s
        hints = waiting_hints(team, journal, began_s + 30)
        assert set(hints) == {"b01", "b02"}
        assert hints["b01"].startswith("it may roll back a change: wait up to ")
        assert hints["b02"].startswith("leave it on: its firmware may still be written (the flash began 30 s ago)")
        assert waiting_hints(team, journal, began_s + 24 * 3600) == {}


def test_its_hint_replaces_the_advice_to_switch_it_off() -> None:
    def hint(why: NoAnswer) -> str:
        heard = (Sighting("b01", 500, -60),)
        alarm = no_answer_alarm(why, None, heard, 0.0, is_required=True, trust="", first_contact_hint="")
        assert alarm is not None
        return alarm.hint

    assert "keep it off" in hint(NoAnswer("no answer"))
    assert hint(NoAnswer("no answer", wait_for="leave it on")) == "leave it on"
