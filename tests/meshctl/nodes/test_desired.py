"""The facts kept from an observed device, and the desired state that results."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from meshctl.device.observation import BoardInfo
from meshctl.nodes.desired import Renderer, device_facts
from meshctl.render.template_files import TemplateFile
from meshctl.render.templates import Templates
from meshctl.resources import shipped
from meshctl.uci import Package
from tests.meshctl.plan.support import factory, fleet, secret

TEAM = fleet()
NODE = TEAM.nodes["b01"]
BOARD = BoardInfo("compex,wpj344-16m", lan_ports=("eth0.1",), switch_vlans=(("switch0", "1", "3 0t"),))
SEEN = replace(factory(TEAM, "b01"), board=BOARD)


def kinds(package: Package) -> list[str]:
    return [section.type for section in package.sections]


def test_an_unobserved_device_has_no_facts() -> None:
    assert (device_facts(NODE, None).compat_version, device_facts(NODE, None).packages) == ("", {})


def test_the_board_provides_the_switch_layout_that_vlan_ports_need() -> None:
    facts = device_facts(replace(NODE, lan_ports=("eth0.1",)), SEEN)
    assert kinds(facts.packages["network"]) == ["interface", "switch", "switch_vlan"]


def test_without_vlan_ports_no_switch_layout_is_added() -> None:
    assert kinds(device_facts(NODE, SEEN).packages["network"]) == ["interface"]


def test_an_unparsable_uci_package_is_not_a_device_fact() -> None:
    broken = replace(SEEN, uci={"network": "config", "system": "config system\n\toption compat_version '1.1'\n"})
    facts = device_facts(NODE, broken)
    assert (facts.compat_version, list(facts.packages)) == ("1.1", ["system"])


def test_a_node_is_rendered_once_for_all_its_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    rendered: list[str] = []
    text = Templates.text

    def counted(self: Templates, file: TemplateFile, *rest: Any) -> str:
        rendered.append(file.path)
        return text(self, file, *rest)

    monkeypatch.setattr(Templates, "text", counted)
    renderer = Renderer.of(TEAM, secret)
    plain = renderer.desired(NODE)
    assert len(set(rendered)) == len(rendered) > 0
    assert SEEN.uci is not None
    network = f"{SEEN.uci['network']}\nconfig switch\n\toption name 'switch0'\n"
    with_switch = replace(SEEN, uci={**SEEN.uci, "network": network})
    kept = renderer.desired(NODE, with_switch)
    assert renderer.desired(NODE, SEEN).files == plain.files
    assert len(set(rendered)) == len(rendered)
    # the same as rendering it with its facts alone
    assert kept == Renderer.of(TEAM, secret).desired(NODE, with_switch)
    assert kept.files != plain.files


def test_a_compat_version_is_rendered() -> None:
    renderer = Renderer.of(TEAM, secret)
    renderer.desired(NODE)
    assert SEEN.uci is not None
    seen = replace(SEEN, uci={**SEEN.uci, "system": "config system\n\toption compat_version '1.1'\n"})
    system = next(file for file in renderer.desired(NODE, seen).files if file.path == "etc/config/system")
    assert "option compat_version '1.1'" in system.content.decode()


def test_the_shipped_templates_read_only_the_compat_version_of_the_device() -> None:
    """`render` does not render them again for a device without one."""
    used = {
        words
        for template in shipped("templates").rglob("*.j2")
        for words in re.findall(
            r"(?<!\.)\bdevice\b(?:\.\w+)?", "".join(re.findall(r"{[{%].*?[%}]}", template.read_text(), re.S))
        )
    }
    assert used == {"device.compat_version"}
