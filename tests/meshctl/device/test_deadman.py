"""What the dead-man's switch does and what it refuses, verb by verb, on the real busybox ash."""

from __future__ import annotations

import gzip
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from meshctl.archive import TarMember, tar_of
from meshctl.device.deadman import Change, NewFile, bundle
from meshctl.device.parse.deadman import parse_status
from meshctl.device.scripts import script
from tests.meshctl.device.changes import (
    BEFORE,
    BUNDLE,
    NONCE,
    NONCE_HASH,
    OWNER,
    RELOAD,
    change,
    is_after,
    is_before,
    live,
    prepare,
    refusal,
)
from tests.meshctl.device.sandbox import Sandbox
from tests.meshctl.device.servers import eventually

LONG = "100000"
OTHER = "bob@base:run-1"


def staged(node: Sandbox, wanted: Change | None = None) -> None:
    prepare(node, wanted)
    assert node.deadman("lock", OWNER, LONG) == f"ok lock_owner={OWNER}"
    assert node.deadman("stage", OWNER, "c1", BUNDLE) == "ok state=staged id=c1"


def armed(node: Sandbox, window_s: str = LONG, wanted: Change | None = None) -> None:
    staged(node, wanted)
    assert node.deadman("arm", OWNER, "c1", NONCE_HASH, window_s) == "ok state=armed id=c1"


def applied(node: Sandbox, window_s: str = LONG, wanted: Change | None = None) -> None:
    armed(node, window_s, wanted)
    assert node.deadman("apply", OWNER, "c1", "now").startswith("ok state=waiting id=c1")
    eventually(lambda: state(node) in {"applied", "idle"})


def state(node: Sandbox) -> str:
    status = parse_status(node.deadman("status"))
    assert status is not None
    return status.state


def last(node: Sandbox) -> tuple[str, str, str]:
    status = parse_status(node.deadman("status"))
    assert status is not None
    return status.last_id, status.last_outcome, status.last_reason


def uptime_s() -> float:
    return float(Path("/proc/uptime").read_text().split()[0])


def test_a_confirmed_change_persists_and_the_services_use_it(node: Sandbox) -> None:
    applied(node)
    assert is_after(node.path("/etc"))
    assert node.deadman("confirm", "c1", NONCE) == "ok state=idle id=c1 outcome=confirmed"
    eventually(lambda: not node.processes())
    assert is_after(node.path("/etc"))
    assert "10.42.0.13" in (node.text("/harness/running") or "")
    assert last(node) == ("c1", "confirmed", "operator")
    assert not node.path("/etc/meshctl/change").exists()
    node.reboot()
    node.deadman("boot")
    assert is_after(node.path("/etc"))


def test_an_unconfirmed_change_is_rolled_back_and_the_services_are_reloaded(node: Sandbox) -> None:
    applied(node, window_s="1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert "192.168.1.1" in (node.text("/harness/running") or "")
    assert last(node) == ("c1", "restored", "timeout")
    assert refusal(node.deadman("confirm", "c1", NONCE)) == "restored"


@pytest.mark.parametrize("is_confirmed", [True, False])
def test_a_change_of_no_file_reloads_services(node: Sandbox, is_confirmed: bool) -> None:
    """It takes down a radio interface that is left over."""
    for path, (text, mode) in BEFORE.items():
        node.put(path, text, mode)
    node.put(BUNDLE, bundle(Change("c1", {}, RELOAD)))
    node.deadman("lock", OWNER, "1000")
    assert node.deadman("stage", OWNER, "c1", BUNDLE) == "ok state=staged id=c1"
    assert node.deadman("arm", OWNER, "c1", NONCE_HASH, "3" if not is_confirmed else "1000") == "ok state=armed id=c1"
    assert node.deadman("apply", OWNER, "c1", "now").startswith("ok state=waiting")
    eventually(lambda: node.path("/harness/running").exists())
    if is_confirmed:
        eventually(lambda: state(node) == "applied")
        assert node.deadman("confirm", "c1", NONCE) == "ok state=idle id=c1 outcome=confirmed"
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert last(node)[1] == ("confirmed" if is_confirmed else "restored")


def test_an_unconfirmed_change_is_rolled_back_at_boot(node: Sandbox) -> None:
    applied(node)
    node.close_processes()
    node.reboot()
    node.run("/bin/sh", "-c", ". /etc/init.d/meshctl-deadman; boot")
    assert is_before(node.path("/etc"))
    assert last(node) == ("c1", "restored", "boot")
    assert node.path("/tmp/meshctl").exists()


def test_the_boot_hook_runs_before_every_service_that_reads_restored_files() -> None:
    hook = script("deadman.init")
    assert hook.startswith("#!/bin/sh /etc/rc.common\n")
    start = re.search(r"^START=(\d+)$", hook, re.MULTILINE)
    assert start is not None
    # procd runs /etc/rc.d/S* in the order of their names: boot, system, log, dropbear, network
    assert f"S{start[1]}meshctl-deadman" < min("S10boot", "S10system", "S12log", "S19dropbear", "S20network")


def test_only_the_right_nonce_confirms_and_only_an_applied_change(node: Sandbox) -> None:
    armed(node)
    assert refusal(node.deadman("confirm", "c1", NONCE)) == "not-applied"
    node.deadman("apply", OWNER, "c1", "now")
    eventually(lambda: state(node) == "applied")
    assert refusal(node.deadman("confirm", "c1", "guess")) == "wrong-nonce"
    assert refusal(node.deadman("confirm", "c2", NONCE)) == "wrong-state"
    assert node.deadman("confirm", "c1", NONCE).startswith("ok")
    assert node.deadman("confirm", "c1", NONCE) == "ok state=idle id=c1 outcome=confirmed"
    assert refusal(node.deadman("confirm", "c1", "guess")) == "wrong-state"


def test_the_nonce_is_not_written_to_flash_before_confirmation(node: Sandbox) -> None:
    applied(node)
    for path in node.path("/etc").rglob("*"):
        if path.is_file() and not path.is_symlink():
            assert NONCE not in path.read_text(errors="replace")


def test_aborting_an_applied_change_rolls_it_back_immediately(node: Sandbox) -> None:
    applied(node)
    assert node.deadman("abort", OWNER, "c1").startswith("ok")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert last(node) == ("c1", "restored", "abort")
    assert "192.168.1.1" in (node.text("/harness/running") or "")


def test_staging_and_arming_change_no_files_and_can_be_aborted(node: Sandbox) -> None:
    staged(node)
    assert is_before(node.path("/etc"))
    assert node.deadman("abort", OWNER, "c1") == "ok state=idle id=c1"
    assert node.deadman("stage", OWNER, "c1", BUNDLE).startswith("ok")
    assert node.deadman("arm", OWNER, "c1", NONCE_HASH, LONG).startswith("ok")
    assert is_before(node.path("/etc"))
    assert node.deadman("abort", OWNER, "c1") == "ok state=idle id=c1"
    assert is_before(node.path("/etc"))
    assert node.text("/harness/running") is None


def test_repeated_verbs_after_a_lost_answer_are_harmless(node: Sandbox) -> None:
    staged(node)
    assert node.deadman("stage", OWNER, "c1", BUNDLE).startswith("ok")
    assert node.deadman("arm", OWNER, "c1", NONCE_HASH, LONG).startswith("ok")
    assert node.deadman("arm", OWNER, "c1", NONCE_HASH, LONG).startswith("ok")
    assert node.deadman("apply", OWNER, "c1", "now").startswith("ok")
    assert refusal(node.deadman("apply", OWNER, "c1", "now")) == "busy"


def test_a_newer_stage_takes_the_place_of_one_that_was_not_armed(node: Sandbox) -> None:
    staged(node)
    node.put(BUNDLE, bundle(change("c2")))
    assert node.deadman("stage", OWNER, "c2", BUNDLE) == "ok state=staged id=c2"
    assert refusal(node.deadman("arm", OWNER, "c1", NONCE_HASH, LONG)) == "wrong-state"
    assert node.deadman("arm", OWNER, "c2", NONCE_HASH, LONG).startswith("ok")
    assert refusal(node.deadman("stage", OWNER, "c1", BUNDLE)) == "busy"


def test_another_operator_is_locked_out_until_the_lock_is_released(node: Sandbox) -> None:
    prepare(node)
    assert refusal(node.deadman("stage", OWNER, "c1", BUNDLE)) == "not-locked"
    assert node.deadman("lock", OWNER, LONG).startswith("ok")
    assert refusal(node.deadman("lock", OTHER, LONG)) == "locked"
    assert refusal(node.deadman("stage", OTHER, "c1", BUNDLE)) == "locked"
    assert node.deadman("unlock", OTHER) == "ok"
    assert refusal(node.deadman("lock", OTHER, LONG)) == "locked"
    assert node.deadman("lock", OWNER, LONG).startswith("ok")
    assert node.deadman("unlock", OWNER) == "ok"
    assert node.deadman("lock", OTHER, LONG).startswith("ok")


def test_a_change_still_belongs_to_its_owner_after_the_lock_is_lost(node: Sandbox) -> None:
    armed(node)
    node.deadman("unlock", OWNER)
    assert node.deadman("lock", OTHER, LONG).startswith("ok")
    assert refusal(node.deadman("apply", OTHER, "c1", "now")) == "wrong-state"
    # but the holder of the lock may abort a change that its owner left behind
    assert node.deadman("abort", OTHER, "c1").startswith("ok")


def test_a_lock_expires_after_its_ttl_and_on_reboot(node: Sandbox) -> None:
    assert node.deadman("lock", OWNER, "1").startswith("ok")
    eventually(lambda: node.deadman("lock", OTHER, LONG).startswith("ok"))
    boot_id = node.text("/harness/boot_id")
    node.put("/harness/boot_id", "11111111-2222-3333-4444-555555555555\n")
    assert node.deadman("lock", OWNER, LONG).startswith("ok"), f"a lock of boot {boot_id} counts no more"


def test_exactly_one_of_many_concurrent_lock_requests_succeeds(node: Sandbox) -> None:
    owners = [f"operator-{n}" for n in range(12)]
    for _ in range(3):
        with ThreadPoolExecutor(len(owners)) as pool:
            answers = list(pool.map(lambda owner: node.deadman("lock", owner, LONG), owners))
        winners = [owner for owner, answer in zip(owners, answers, strict=True) if answer.startswith("ok")]
        assert len(winners) == 1, answers
        assert f"lock_owner={winners[0]} " in node.deadman("status")
        node.deadman("unlock", winners[0])


def test_foreign_uncommitted_changes_are_refused_before_anything_happens(node: Sandbox) -> None:
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    node.put("/tmp/.uci/delta", "network.lan.ipaddr='10.0.0.9'\n")
    answer = node.deadman("stage", OWNER, "c1", BUNDLE)
    assert refusal(answer) == "foreign-changes"
    assert "network.lan.ipaddr='10.0.0.9'" in answer
    assert not node.path("/etc/meshctl/change").exists()
    node.path("/tmp/.uci/delta").unlink()
    node.deadman("stage", OWNER, "c1", BUNDLE)
    node.put("/tmp/.uci/delta", "wireless.radio0.channel='1'\n")
    assert refusal(node.deadman("arm", OWNER, "c1", NONCE_HASH, LONG)) == "foreign-changes"


def test_a_file_changed_since_planning_is_rejected_at_stage(node: Sandbox) -> None:
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    for path, text in (("/etc/config/network", "edited\n"), ("/etc/new/place/of.conf", "made by hand\n")):
        node.put(path, text)
        answer = node.deadman("stage", OWNER, "c1", BUNDLE)
        assert refusal(answer) == "moved-on"
        assert path in answer
        node.path("/etc/config/network").write_text(BEFORE["/etc/config/network"][0])
    assert not node.path("/etc/meshctl/change").exists()


def test_an_edit_between_stage_and_arm_is_refused(node: Sandbox) -> None:
    staged(node)
    node.put("/etc/config/network", "edited\n")
    assert refusal(node.deadman("arm", OWNER, "c1", NONCE_HASH, LONG)) == "moved-on"


def test_an_edit_during_the_countdown_is_kept_and_the_change_dropped(node: Sandbox) -> None:
    armed(node)
    node.put("/etc/config/network", "edited in the last moment\n")
    # what `apply` starts, with a countdown that ends now
    node.path("/tmp/meshctl/change-c1").mkdir(exist_ok=True)
    node.deadman("watch", "c1", "0")
    assert node.text("/etc/config/network") == "edited in the last moment\n"
    assert live(node.path("/etc")).items() >= {k: v for k, v in BEFORE.items() if k != "/etc/config/network"}.items()
    assert last(node) == ("c1", "refused", "moved-on")


def test_a_scheduled_change_can_be_aborted_until_its_due_time(node: Sandbox) -> None:
    armed(node)
    answer = node.deadman("apply", OWNER, "c1", "in", "1000.5")
    status = parse_status(node.deadman("status"))
    assert status is not None
    assert status.state == "waiting"
    assert answer.endswith(f"due_uptime_s={status.due_uptime_s:.2f}")
    assert is_before(node.path("/etc"))
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: state(node) == "idle" and not node.processes())
    assert is_before(node.path("/etc"))
    assert node.text("/harness/running") is None


def test_the_apply_time_is_given_as_the_nodes_uptime(node: Sandbox) -> None:
    armed(node)
    uptime = uptime_s()
    assert refusal(node.deadman("apply", OWNER, "c1", "at", f"{uptime - 5:.2f}")) == "too-late"
    assert is_before(node.path("/etc"))
    due = f"{uptime + 2.25:.2f}"
    answer = node.deadman("apply", OWNER, "c1", "at", due)
    if not answer.startswith("refused too-late"):
        assert answer == f"ok state=waiting id=c1 due_uptime_s={due}"
        eventually(lambda: state(node) == "applied")


def test_a_hanging_reload_does_not_block_the_rollback(node: Sandbox) -> None:
    hangs = change(reload="grep -q 192.168.1.1 /etc/config/network && echo back >>/harness/running || sleep 100000")
    applied(node, window_s="1", wanted=hangs)
    eventually(lambda: node.text("/harness/running") == "back\n")
    assert is_before(node.path("/etc"))


def test_a_reload_gets_its_deadline_and_the_rollback_reload_gets_none(node: Sandbox) -> None:
    log = 'echo "${UNTIL_S:-none}" >>/harness/log'
    armed(node, "60", change(reload=log))
    before_s = uptime_s()
    node.deadman("apply", OWNER, "c1", "now")
    eventually(lambda: state(node) == "applied" and bool(node.text("/harness/log")))
    after_s = uptime_s()
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: len((node.text("/harness/log") or "").split()) == 2)
    until, back = (node.text("/harness/log") or "").split()
    assert int(before_s) <= int(until) - 60 + 3 <= after_s
    assert back == "none"


def test_a_rollback_waits_for_a_running_reload_to_finish(node: Sandbox) -> None:
    # two of OpenWrt's reload_config at once spoil each other's list of what changed
    log = "echo begin >>/harness/log; until [ -e /harness/go ]; do sleep 0.1; done; echo end >>/harness/log"
    applied(node, wanted=change(reload=log))
    eventually(lambda: node.text("/harness/log") == "begin\n")
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: is_before(node.path("/etc")))
    node.put("/harness/go", "")
    eventually(lambda: (node.text("/harness/log") or "").count("end") == 2)
    assert node.text("/harness/log") == "begin\nend\nbegin\nend\n"


def test_no_change_is_staged_while_a_rollback_reloads(node: Sandbox) -> None:
    # the status of that reload would count for the new change, before its own services have reloaded
    second = "[ ! -e /harness/first ] || until [ -e /harness/go ]; do sleep 0.1; done"
    log = f"echo begin >>/harness/log; {second}; : >/harness/first"
    applied(node, wanted=change(reload=log))
    eventually(lambda: (node.text("/harness/log") or "") == "begin\n" and node.path("/harness/first").exists())
    node.deadman("abort", OWNER, "c1")
    eventually(lambda: (node.text("/harness/log") or "") == "begin\nbegin\n")
    assert re.search(r" state=idle .* restored_reload=yes", node.deadman("status"))
    prepare(node)
    switch = "/usr/sbin/meshctl-deadman"
    node.put("/harness/hasty", (node.text(switch) or "").replace("RESTORED_WAIT_CS=2000", "RESTORED_WAIT_CS=20"), 0o755)
    refused = node.run("/harness/hasty", "stage", OWNER, "c1", BUNDLE).stdout
    assert refused.startswith("refused busy services are still reloading"), refused
    with ThreadPoolExecutor(1) as hand:
        waiting = hand.submit(node.deadman, "stage", OWNER, "c1", BUNDLE)
        node.put("/harness/go", "")
        assert waiting.result() == "ok state=staged id=c1"
    assert " restored_reload=no" in node.deadman("status")


def test_a_foreign_process_under_the_number_of_a_killed_rollback_holds_no_change_off(node: Sandbox) -> None:
    prepare(node)
    assert node.deadman("lock", OWNER, "600").startswith("ok")
    foreign = node.run("/bin/sh", "-c", "sleep 600 >/dev/null 2>&1 & echo $!").stdout.strip()
    try:
        node.put("/tmp/meshctl/restoring", f"{foreign}\n")
        assert node.deadman("stage", OWNER, "c1", BUNDLE) == "ok state=staged id=c1"
    finally:
        node.run("/bin/sh", "-c", f"kill {foreign}")


OVERLAY_IN_RAM = "overlayfs:/tmp/root"
INITRAMFS_19_07 = "rootfs"


@pytest.mark.parametrize("device", [OVERLAY_IN_RAM, INITRAMFS_19_07])
def test_staging_is_rejected_while_the_root_is_in_ram(node: Sandbox, device: str) -> None:
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    stage = f"exec /usr/sbin/meshctl-deadman stage {OWNER} c1 {BUNDLE}"
    done = node.run("/bin/sh", "-c", f"/bin/busybox mount -t tmpfs {device} / && {stage}")
    assert done.stdout.startswith("refused no-flash "), done
    assert not node.path("/etc/meshctl/change").exists()


def test_the_kernels_own_rootfs_below_an_overlay_does_not_count(node: Sandbox) -> None:
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    stage = f"exec /usr/sbin/meshctl-deadman stage {OWNER} c1 {BUNDLE}"
    mounts = "".join(f"/bin/busybox mount -t tmpfs {device} / && " for device in ("rootfs", "overlayfs:/overlay"))
    done = node.run("/bin/sh", "-c", f"{mounts}{stage}")
    assert done.stdout.startswith("ok state=staged "), done


@pytest.mark.parametrize("reported", ['"rootfs_type": "initramfs",', '"initramfs": true,'], ids=["22.03 on", "21.02"])
def test_staging_is_rejected_on_an_initramfs_image(node: Sandbox, reported: str) -> None:
    prepare(node)
    node.put("/bin/ubus", f"""#!/bin/sh\n[ "$*" != "call system board" ] || echo '\t{reported}'\n""", 0o755)
    node.deadman("lock", OWNER, LONG)
    assert node.deadman("stage", OWNER, "c1", BUNDLE).startswith("refused no-flash ")


def test_staging_is_rejected_until_the_first_boot_after_a_flash_has_ended(node: Sandbox) -> None:
    """Until the end of that boot, the next one would unpack sysupgrade's archive over a confirmed change."""
    prepare(node)
    node.put("/sysupgrade.tgz", "the configuration that the flash kept")
    node.deadman("lock", OWNER, LONG)
    assert node.deadman("stage", OWNER, "c1", BUNDLE).startswith("refused no-flash its first boot after a flash ")
    assert not node.path("/etc/meshctl/change").exists()
    # base-files, etc/init.d/done
    node.run("/bin/sh", "-c", "rm -f /sysupgrade.tgz")
    assert node.deadman("stage", OWNER, "c1", BUNDLE).startswith("ok state=staged ")


def test_the_node_reboots_if_reloading_the_restored_state_fails(node: Sandbox) -> None:
    applied(node, window_s="1", wanted=change(reload="exit 1"))
    eventually(lambda: node.text("/harness/reboots") == "reboot\n")
    assert is_before(node.path("/etc"))
    assert not node.path("/etc/meshctl/change").exists()


def test_a_change_whose_timer_was_killed_is_orphaned_and_can_be_aborted(node: Sandbox) -> None:
    applied(node)
    pid = (node.text("/tmp/meshctl/change-c1/watch.pid") or "").strip()
    assert node.run("/bin/sh", "-c", f"kill -9 {pid}").returncode == 0
    eventually(lambda: state(node) == "orphaned")
    assert node.deadman("abort", OWNER, "c1").startswith("ok")
    eventually(lambda: state(node) == "idle")
    assert is_before(node.path("/etc"))


def test_without_the_boot_hook_nothing_is_armed(node: Sandbox) -> None:
    staged(node)
    node.path("/etc/rc.d/S05meshctl-deadman").unlink()
    assert refusal(node.deadman("arm", OWNER, "c1", NONCE_HASH, LONG)) == "not-enabled"


def test_unparsable_uci_is_rejected_at_stage(node: Sandbox) -> None:
    prepare(node)
    broken = Change("c1", {"/etc/config/wireless": NewFile(b"BROKEN")}, "true")
    node.put(BUNDLE, bundle(broken))
    node.deadman("lock", OWNER, LONG)
    answer = node.deadman("stage", OWNER, "c1", BUNDLE)
    assert refusal(answer) == "bad-uci"
    assert answer.endswith("wireless")
    assert not list(node.path("/etc/meshctl").glob("change*"))


@pytest.mark.parametrize(
    "path",
    [
        "/tmp/x",
        "/etc",
        "/etc/meshctl/last",
        "/etc/../tmp/x",
        "/etc//x",
        "/etc/./x",
        "/etc/config",
        "etc/x",
        "/proc/x/y",
    ],
)
def test_the_node_rejects_paths_that_are_not_files_in_flash(node: Sandbox, path: str) -> None:
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    manifest = f"remove - - - {path}\n".encode()
    node.put(BUNDLE, gzip.compress(tar_of([TarMember("manifest", manifest), TarMember("reload", b"true\n")])))
    assert refusal(node.deadman("stage", OWNER, "c1", BUNDLE)) == "bad-path"
    assert is_before(node.path("/etc"))
    assert not list(node.path("/etc/meshctl").glob("change*"))


@pytest.mark.parametrize("damage", ["cut", "empty", "missing", "other"])
def test_a_damaged_bundle_is_refused(node: Sandbox, damage: str) -> None:
    prepare(node)
    node.deadman("lock", OWNER, LONG)
    whole = bundle(change())
    other = gzip.compress(tar_of([TarMember("manifest", b"file 0644 00 - /etc/a/b\n"), TarMember("reload", b"")]))
    node.put(BUNDLE, {"cut": whole[:-40], "empty": b"", "missing": b"", "other": other}[damage])
    if damage == "missing":
        node.path(BUNDLE).unlink()
    assert refusal(node.deadman("stage", OWNER, "c1", BUNDLE)) in {"bad-bundle", "flash-full"}
    assert is_before(node.path("/etc"))
    assert not list(node.path("/etc/meshctl").glob("change*"))


@pytest.mark.parametrize(
    "words", [("fly",), (), ("lock", "a b", "1"), ("lock", "a", "-1"), ("lock", "", "1"), ("lock",)]
)
def test_invalid_verbs_and_arguments_are_usage_errors(node: Sandbox, words: tuple[str, ...]) -> None:
    assert refusal(node.deadman(*words)) == "usage"


def test_a_bundle_is_deterministic_and_invalid_changes_raise_before_upload() -> None:
    assert bundle(change()) == bundle(change())
    for files in (
        {"/x": NewFile(b"")},
        {"/etc/a b": NewFile(b"")},
        {"/etc/../x": NewFile(b"")},
        {"etc/x": NewFile(b"")},
    ):
        with pytest.raises(ValueError, match="absolute path"):
            bundle(Change("c", files, "true"))
    with pytest.raises(ValueError, match="named twice"):
        bundle(Change("c", {"/etc/a/b": NewFile(b"")}, "true", removed=("/etc/a/b",)))
    with pytest.raises(ValueError, match=r"\.\./init\.d"):
        bundle(Change("c", {}, "true", links={"/etc/a/b": "/tmp"}))
