"""A change contains the files that differ and their previous hashes, and reloads what changed."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from meshctl.apply.change_set import change_of, new_change_id, new_nonce, reload_script
from meshctl.device.deadman import bundle
from tests.meshctl.plan.support import PASS_PHRASE, factory, fleet, planned, running, wanted


def test_a_change_holds_only_differing_files_and_their_previous_hashes() -> None:
    team, seen = fleet(channel=11), running(fleet(), "b01")
    change = change_of("c1", planned(team, "b01", seen), wanted(team, "b01"), seen, ())
    assert set(change.files) == {"/etc/config/wireless", "/etc/meshctl/node"}
    assert seen.uci is not None
    assert change.expected["/etc/config/wireless"] == hashlib.sha256(seen.uci["wireless"].encode()).hexdigest()
    assert change.reload == reload_script({"etc/config/wireless"}, ())


def test_a_missing_file_is_expected_to_stay_absent() -> None:
    seen = factory(fleet(), "b01")
    change = change_of("c1", planned(fleet(), "b01", seen), wanted(fleet(), "b01"), seen, ())
    assert change.expected["/etc/dropbear/authorized_keys"] is None


def test_a_file_with_undecodable_bytes_has_no_expected_hash() -> None:
    team, seen = fleet(channel=11), running(fleet(), "b01")
    assert seen.uci is not None
    odd = replace(seen, uci={**seen.uci, "wireless": seen.uci["wireless"] + "# \ufffd\n"})
    change = change_of("c1", planned(team, "b01", odd), wanted(team, "b01"), odd, ())
    assert "/etc/config/wireless" not in change.expected


def test_every_rendered_path_is_accepted_by_the_dead_mans_switch() -> None:
    seen = factory(fleet(), "b01")
    assert bundle(change_of("c1", planned(fleet(), "b01", seen), wanted(fleet(), "b01"), seen, ()))


def test_a_change_is_never_printed_with_its_secrets() -> None:
    seen = factory(fleet(), "b01")
    plan = planned(fleet(), "b01", seen)
    assert PASS_PHRASE not in repr(change_of("c1", plan, wanted(fleet(), "b01"), seen, ()))
    assert PASS_PHRASE not in repr(wanted(fleet(), "b01"))


def test_ids_and_nonces_never_repeat() -> None:
    assert len({new_change_id() for _ in range(100)}) == 100
    assert len({new_nonce().reveal() for _ in range(100)}) == 100
