"""The key of a robot's collector: on that robot's radios alone, for one script alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.device.link_table import answering_script
from meshctl.diagnostics import InvalidInput
from meshctl.inventory import load_fleet
from meshctl.lint.sshkey import parse_authorized_key
from meshctl.model import Fleet, Secret
from meshctl.render import LINKS_PATH, Rendered, render_node

ROOT = Path(__file__).resolve().parents[3]
KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g collector of husky1"
AUTHORIZED_KEYS = "etc/dropbear/authorized_keys"


def fleet(key: str = KEY, *, collector: bool = True) -> Fleet:
    whole = load_fleet(ROOT / "inventory/subt-final")
    husky = whole.robots["husky1"]
    assert husky.computer is not None
    changed = replace(husky, computer=replace(husky.computer, collector=collector, collector_key=key))
    return replace(whole, robots={**whole.robots, "husky1": changed})


def rendered(node: str, of: Fleet) -> Rendered:
    return render_node(of, node, lambda _: Secret("cedar-lantern-93-quarry"))


def text(node: str, path: str, of: Fleet) -> str | None:
    return next((file.content.decode() for file in rendered(node, of).files if file.path == path), None)


def test_the_robots_radios_accept_the_key_for_the_script_that_prints_links() -> None:
    for node in ("husky1-front", "husky1-rear"):
        keys = text(node, AUTHORIZED_KEYS, fleet())
        assert keys is not None
        (line,) = (line for line in keys.splitlines() if KEY in line)
        options = line.removesuffix(f" {KEY}").split(",")
        assert options == [
            'command="sh /etc/meshctl/links.sh"',
            "no-port-forwarding",
            "no-agent-forwarding",
            "no-X11-forwarding",
            "no-pty",
        ]
        assert parse_authorized_key(line).comment == "collector of husky1"
        # the operators' keys come before it, without options
        assert keys.splitlines()[0].startswith("ssh-")
        script = text(node, LINKS_PATH, fleet())
        assert script is not None
        # what the collector asks for, with its comments
        assert [line for line in answering_script().splitlines()[1:] if line not in script] == []


@pytest.mark.parametrize("node", ["base", "husky2-front", "spot1-radio", "husky1-b01"])
def test_other_nodes_do_not(node: str) -> None:
    assert rendered(node, fleet()) == rendered(node, fleet(collector=False))


@pytest.mark.parametrize("changed", [fleet(collector=False), fleet("")], ids=["no collector", "no key yet"])
def test_without_a_collector_or_its_key_nothing_is_accepted(changed: Fleet) -> None:
    assert "links.sh" not in (text("husky1-front", AUTHORIZED_KEYS, changed) or "")
    assert text("husky1-front", LINKS_PATH, changed) is None


@pytest.mark.parametrize("key", ["ssh-ed25519", f"no-pty {KEY}", f"{KEY}\nssh-ed25519 AAAA"])
def test_what_is_not_one_public_key_is_refused_with_its_place(key: str) -> None:
    with pytest.raises(InvalidInput) as refused:
        rendered("husky1-front", fleet(key))
    (found,) = refused.value.diagnostics
    assert found.expected == "one OpenSSH public key on one line"
    assert found.path.endswith("collector_key")
