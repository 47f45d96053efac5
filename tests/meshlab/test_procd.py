"""procd's stand-in against procd's trigger.c, service.c and instance.c (openwrt-facts.md, sections 11 and 12)."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from meshlab.fleet import VirtualFleet, VirtualNode
from meshlab.spec import FleetSpec, NodeSpec
from tests.meshlab.conftest import answers, connect, run
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

MARKER = """ubus call service set '{"name":"mark","triggers":[["config.change",["if",["eq","package","mark"],
    ["run_script","/bin/sh","-c","echo $(cat /tmp/ran) >>/tmp/mark"]],1000]]}'"""


def service(node: VirtualNode, name: str, **words: Any) -> Any:
    asked = json.dumps({"name": name, **words})
    return json.loads(node.exec(f"ubus call service list '{asked}'").check("list").stdout).get(name)


def dropbear(node: VirtualNode) -> dict[str, Any]:
    instance: dict[str, Any] = service(node, "dropbear").get("instances", {}).get("instance1", {})
    return instance


def put_service(node: VirtualNode, name: str, reload: str) -> None:
    """An init script that is reloaded when the package system has changed."""
    script = f"""#!/bin/sh /etc/rc.common
START=50
USE_PROCD=1
reload_service() {{ {reload}; }}
service_triggers() {{ procd_add_reload_trigger system; }}
"""
    node.exec(f"cat >/etc/init.d/{name}; chmod 755 /etc/init.d/{name}", stdin=script.encode()).check("put")
    node.exec(f"/etc/init.d/{name} start").check("start")


def test_reload_config_returns_before_anything_was_reloaded(node: VirtualNode) -> None:
    done = node.exec(
        "uci set system.@system[0].hostname=later; uci commit system; reload_config; cat /proc/sys/kernel/hostname"
    )
    assert (done.exit_status, done.stdout) == (0, "OpenWrt\n")
    until(lambda: node.exec("cat /proc/sys/kernel/hostname").stdout == "later\n", "procd")


def test_the_failure_of_a_script_is_ignored(node: VirtualNode) -> None:
    put_service(node, "broken", "echo ran >>/tmp/ran; return 7")
    changed = node.exec("uci set system.@system[0].hostname=later; uci commit system; reload_config")
    assert (changed.exit_status, changed.stderr) == (0, "")
    until(lambda: node.exec("cat /tmp/ran").stdout == "ran\n", "the script")


def test_a_custom_trigger_runs_delayed_and_after_earlier_triggers(node: VirtualNode) -> None:
    node.exec(MARKER).check("register")
    listed = service(node, "mark", verbose=True)
    assert listed["triggers"][0][1][1] == ["eq", "package", "mark"]
    put_service(node, "slow", "sleep 1; echo slow >/tmp/ran")
    begun_s = time.monotonic()
    event = 'ubus call service event \'{"type":"config.change","data":{"package":"mark"}}\''
    node.exec(f"uci set system.@system[0].hostname=x; uci commit system; reload_config; {event}").check("change")
    until(lambda: node.exec("cat /tmp/mark").stdout != "", "the trigger")
    assert time.monotonic() - begun_s > 2
    assert node.exec("cat /tmp/mark").stdout == "slow\n"
    node.exec("""ubus call service delete '{"name":"mark"}'""").check("delete")
    assert node.exec("""ubus call service delete '{"name":"mark"}'""").exit_status == 4
    assert service(node, "mark") is None


def test_events_within_a_second_are_merged_but_an_event_during_a_run_triggers_another(node: VirtualNode) -> None:
    node.exec(
        """ubus call service set '{"name":"mark","triggers":[["config.change",["if",["eq","package","mark"],
        ["run_script","/bin/sh","-c","echo ran >>/tmp/mark; sleep 2"]],1000]]}'"""
    ).check("register")
    event = 'ubus call service event \'{"type":"config.change","data":{"package":"mark"}}\''
    node.exec(f"{event}; {event}").check("twice")
    until(lambda: node.exec("cat /tmp/mark").stdout == "ran\n", "the trigger")
    node.exec("sleep 3")
    assert node.exec("cat /tmp/mark").stdout == "ran\n"
    node.exec(event).check("once more")
    until(lambda: node.exec("cat /tmp/mark").stdout == "ran\nran\n", "the second")
    node.exec(event).check("while it runs")
    until(lambda: node.exec("cat /tmp/mark").stdout == "ran\nran\nran\n", "the third")


def test_dropbear_is_listed_like_in_procd_and_restarted_only_on_a_command_change(node: VirtualNode) -> None:
    before = dropbear(node)
    assert before["running"] is True
    assert before["command"][:2] == ["/usr/sbin/dropbear", "-F"]
    assert before["term_timeout"] == 5
    assert before["respawn"] == {"threshold": 3600, "timeout": 5, "retry": 5}
    node.exec("/etc/init.d/dropbear reload").check("reload")
    assert dropbear(node)["pid"] == before["pid"]
    transport = connect(node.bench)
    node.exec("uci set dropbear.@dropbear[0].Port=2222; uci commit; reload_config").check("change")
    assert dropbear(node)["pid"] == before["pid"]
    until(lambda: dropbear(node).get("pid", before["pid"]) != before["pid"], "another process")
    assert not answers(node.bench)
    assert run(transport, "echo still here") == "still here\n"
    transport.close()


def test_an_ssh_server_on_the_inventory_s_port_is_reached_there_and_at_the_factory_s(tmp_path: Path) -> None:
    with VirtualFleet(FleetSpec("ports", (NodeSpec("box", ssh_port=2222),)), tmp_path) as fleet:
        node = fleet.node("box")
        before = dropbear(node)["pid"]
        connect(node.bench).close()
        node.exec("uci set dropbear.@dropbear[0].Port=2222; uci commit; reload_config").check("change")
        until(lambda: dropbear(node).get("pid", before) != before, "another process")
        until(lambda: answers(node.bench), "the SSH server at its new port")


@pytest.mark.parametrize(
    "change", ["enable=0", "Interface=absent", "PasswordAuth=perhaps", "Port=ssh"], ids=lambda text: text.split("=")[0]
)
def test_disabled_dropbear_stops_listening_but_keeps_open_sessions(node: VirtualNode, change: str) -> None:
    transport = connect(node.bench)
    node.exec(f"uci set dropbear.@dropbear[0].{change}; uci commit; reload_config").check("change")
    assert answers(node.bench)
    until(lambda: not answers(node.bench), "the end of the server")
    # procd hears of it after its socket is closed
    until(lambda: service(node, "dropbear") == {}, "the end of the service")
    assert run(transport, "echo still here") == "still here\n"
    transport.close()


def test_a_service_that_dies_comes_back_after_five_seconds(node: VirtualNode) -> None:
    before = dropbear(node)
    node.exec(f"kill {before['pid']}").check("kill")
    until(lambda: dropbear(node).get("running") is False, "its end")
    assert "exit_code" in dropbear(node)
    until(lambda: dropbear(node).get("running") is True, "its return")
    assert dropbear(node)["pid"] != before["pid"]


def test_a_custom_service_is_started_restarted_on_change_and_stopped(fleet: VirtualFleet, node: VirtualNode) -> None:
    def put(seconds: int) -> None:
        asked = json.dumps({"name": "own", "instances": {"one": {"command": ["/bin/sleep", str(seconds)]}}})
        node.exec(f"ubus call service set '{asked}'").check("set")

    put(600)
    first = service(node, "own")["instances"]["one"]
    assert (first["running"], first["command"]) == (True, ["/bin/sleep", "600"])
    put(600)
    assert service(node, "own")["instances"]["one"]["pid"] == first["pid"]
    put(601)
    until(lambda: service(node, "own")["instances"]["one"].get("pid", first["pid"]) != first["pid"], "the restart")
    node.exec("""ubus call service delete '{"name":"own"}'""").check("delete")
    until(lambda: "sleep 601" not in node.exec("ps").stdout, "its end")
    assert node.exec("ubus call service set '{}'").exit_status == 2
