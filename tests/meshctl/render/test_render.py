"""Laws of rendering: values arrive unchanged or are refused, secrets stay secret, same input gives same bytes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from meshctl.diagnostics import InvalidInput
from meshctl.file_access import Boundary
from meshctl.model import (
    MASK,
    Backend,
    Encryption,
    Fleet,
    MeshMode,
    NodeState,
    OperatorParts,
    Operators,
    Secret,
    SystemSettings,
)
from meshctl.render import DeviceFacts, Rendered, Templates, UnknownNode, render_fleet, render_node
from meshctl.render.template_set import TemplateSet
from meshctl.uci import dump, parse
from tests.meshctl.render import fleets

SHARED = Templates.of(fleets.fleet())
NAME = "husky1-front"
hostile = st.text(
    st.one_of(st.sampled_from(" '\"\\\n\t\r;#$`{}%|&é中\0"), st.characters(exclude_categories=["Cs"])), max_size=12
)


def render(fleet: Fleet, key: str = fleets.KEY) -> Rendered:
    return render_node(fleet, NAME, lambda _: Secret(key), SHARED)


def option(rendered: Rendered, package: str, section: str, name: str) -> str:
    tree = rendered.package(package)
    assert tree is not None
    if section.startswith("@"):
        return tree.sections[tree.keys().index(section)].get(name)
    found = tree.section(section)
    assert found is not None
    return found.get(name)


@given(hostile, hostile, hostile, hostile)
def test_hostile_values_are_rendered_unchanged_or_rejected(ssid: str, label: str, path: str, host: str) -> None:
    radio = replace(fleets.node().radios[0], hardware=replace(fleets.RADIO_2G, path=path))
    fleet = fleets.fleet(
        fleets.node(label=label, radios=(radio,)),
        meshes=(fleets.mesh(ssid=ssid),),
        system=SystemSettings(log_host=host),
    )
    try:
        rendered = render(fleet)
    except InvalidInput as error:
        assert {item.position.file for item in error.diagnostics} == {"fleet.yaml"}
        return
    assert option(rendered, "wireless", "mesh0", "ssid") == ssid
    assert option(rendered, "wireless", "radio0", "path") == path
    assert option(rendered, "system", "@system[0]", "description") == label
    assert option(rendered, "system", "@system[0]", "log_ip") == host
    for file in rendered.files:
        if file.package is not None:
            assert parse(file.content.decode(), file.path) == file.package


@pytest.mark.parametrize(
    "ssid", ["bob's", '"quoted" \\ back', "four    spaces", "é中", "$(reboot)", "a # b ; c", "'", "\\"]
)
def test_unusual_ssids_are_rendered_unchanged(ssid: str) -> None:
    assert option(render(fleets.fleet(meshes=(fleets.mesh(ssid=ssid),))), "wireless", "mesh0", "ssid") == ssid


# each key costs one derivation for the hash
@settings(max_examples=20)
@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=8, max_size=63))
def test_the_key_is_masked_in_human_readable_text(key: str) -> None:
    fleet = fleets.fleet(meshes=(fleets.mesh(encryption=Encryption.PSK2),))
    other = render(fleet)
    # a key that is part of public text, such as a package's name, cannot be distinguished from it
    assume(key not in other.masked_text + repr(other))
    rendered = render(fleet, key)
    wireless = rendered.file("etc/config/wireless")
    assert wireless is not None
    assert option(rendered, "wireless", "mesh0", "key") == key
    assert f"option key '{MASK}'" in wireless.masked
    assert wireless.mode == 0o600
    assert key not in rendered.masked_text
    assert key not in repr(rendered)


def test_rendering_is_deterministic() -> None:
    fleet = fleets.fleet(meshes=(fleets.mesh(encryption=Encryption.PSK2),))
    assert render(fleet) == render_node(fleet, NAME, lambda _: Secret(fleets.KEY), Templates.of(fleet))


def test_the_hash_depends_on_the_configuration_and_the_key() -> None:
    encrypted = fleets.fleet(meshes=(fleets.mesh(encryption=Encryption.PSK2),))
    hashes = {
        render(fleets.fleet()).config_hash,
        render(encrypted).config_hash,
        render(encrypted, "another key").config_hash,
        render(fleets.fleet(fleets.node(label="other"))).config_hash,
    }
    assert len(hashes) == 4
    assert render(encrypted).config_hash in hashes


def test_compat_version_is_kept_and_does_not_affect_the_hash() -> None:
    fleet = fleets.fleet()
    plain = render(fleet)
    kept = render_node(fleet, NAME, fleets.secrets, SHARED, DeviceFacts(compat_version="1.1"))
    assert option(kept, "system", "@system[0]", "compat_version") == "1.1"
    assert option(plain, "system", "@system[0]", "compat_version") == ""
    assert kept.config_hash == plain.config_hash


def test_the_marker_file_contains_fleet_node_and_hash() -> None:
    rendered = render(fleets.fleet())
    marker = rendered.file("etc/meshctl/node")
    assert marker is not None
    assert marker.content.decode() == f"fleet=test-fleet\nnode={NAME}\nconfig={rendered.config_hash}\n"


def test_authorized_keys_is_readable_by_root_only() -> None:
    keys = render(fleets.fleet()).file("etc/dropbear/authorized_keys")
    assert keys is not None
    assert keys.mode == 0o600
    assert keys.content.decode() == f"{fleets.RSA}\n{fleets.ED25519}\n"


def test_a_fleet_renders_its_managed_nodes_in_order() -> None:
    nodes = [fleets.node(name=name, state=state) for name, state in zip("dcba", NodeState, strict=False)]
    assert [item.node for item in render_fleet(fleets.fleet(*nodes), fleets.secrets, SHARED)] == ["d", "c", "b"]


def test_an_installation_without_templates_renders_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every node would have had the configuration without any file, which was up to date on all of them."""
    monkeypatch.setattr("meshctl.resources._SHIPPED", tmp_path)
    boundary = Boundary((str(tmp_path),))
    with pytest.raises(InvalidInput, match="templates are missing"):
        TemplateSet((tmp_path / "templates",), Backend.BATMAN, OperatorParts(), boundary)


def test_unknown_and_lost_nodes_are_refused() -> None:
    fleet = fleets.fleet(fleets.node(state=NodeState.LOST))
    with pytest.raises(UnknownNode, match="is lost and has no configuration"):
        render(fleet)
    with pytest.raises(UnknownNode, match="expected a node of the fleet, found 'b99'"):
        render_node(fleet, "b99", fleets.secrets)


def test_password_login_is_enabled_only_by_the_inventory() -> None:
    open_fleet = fleets.fleet(operators=Operators((), password_login=True))
    assert option(render(open_fleet), "dropbear", "@dropbear[0]", "PasswordAuth") == "on"
    assert option(render(fleets.fleet()), "dropbear", "@dropbear[0]", "RootPasswordAuth") == "off"


def test_a_radio_without_a_mesh_is_disabled() -> None:
    rendered = render(fleets.fleet())
    assert option(rendered, "wireless", "radio0", "disabled") == "0"
    assert option(rendered, "wireless", "radio1", "disabled") == "1"


def test_an_802_11s_mesh_disables_mesh_forwarding() -> None:
    rendered = render(fleets.fleet(meshes=(fleets.mesh(mode=MeshMode.MESH),)))
    assert option(rendered, "wireless", "mesh0", "mesh_fwding") == "0"
    assert option(rendered, "wireless", "mesh0", "mesh_id") == "fleet"


class TestExtraOptions:
    """The inventory's own options on top of the templates."""

    @staticmethod
    def render(extra: dict[str, str]) -> Rendered:
        return render(fleets.fleet(fleets.node(extra_uci=extra)))

    def test_options_are_set_changed_and_removed(self) -> None:
        rendered = self.render(
            {"wireless.radio0.rts": "500", "wireless.radio0.htmode": "HT40", "system.@system[0].ttylogin": ""}
        )
        assert option(rendered, "wireless", "radio0", "rts") == "500"
        assert option(rendered, "wireless", "radio0", "htmode") == "HT40"
        assert option(rendered, "system", "@system[0]", "ttylogin") == ""

    def test_sections_and_packages_are_created_in_any_order(self) -> None:
        rendered = self.render(
            {"lldpd.config.lldp_class": "4", "lldpd.config": "lldpd", "network.sw.vlan": "1", "network.sw": "switch"}
        )
        lldpd = rendered.package("lldpd")
        assert lldpd is not None
        assert dump(lldpd) == "\nconfig lldpd 'config'\n\toption lldp_class '4'\n\n"
        assert option(rendered, "network", "sw", "vlan") == "1"

    def test_a_plain_text_password_is_masked(self) -> None:
        rendered = self.render({"wireless.mesh0.sae_password": "open sesame", "wireless.mesh0.key1": "1"})
        wireless = rendered.file("etc/config/wireless")
        assert wireless is not None
        assert (option(rendered, "wireless", "mesh0", "sae_password"), wireless.mode) == ("open sesame", 0o600)
        assert "open sesame" not in rendered.masked_text
        assert "option key1 '1'" in rendered.masked_text

    @pytest.mark.parametrize(
        ("extra", "words"),
        [
            ({"wireless.radio9.rts": "1"}, "expected a section of wireless (radio0, mesh0, radio1), found 'radio9'"),
            ({"wireless.radio0": "wifi-iface"}, "expected a section of type 'wifi-device' as rendered"),
            ({"wireless.x": "wifi iface"}, "section type: expected printable ASCII without spaces"),
        ],
    )
    def test_invalid_options_are_rejected_with_their_position(self, extra: dict[str, str], words: str) -> None:
        with pytest.raises(InvalidInput) as caught:
            self.render(extra)
        assert words in str(caught.value)
        assert str(caught.value).startswith("fleet.yaml:11:3: extra_uci.")


class TestTemplates:
    """Templates of the inventory's own, and what goes wrong in them."""

    @staticmethod
    def render(folder: Path, text: str, path: str = "common/etc/config/system.j2") -> Rendered:
        template = folder / "templates" / path
        template.parent.mkdir(parents=True)
        template.write_text(text)
        return render_node(fleets.fleet(base=str(folder)), NAME, fleets.secrets)

    def test_a_template_overrides_the_shipped_file_of_the_same_path(self, tmp_path: Path) -> None:
        rendered = self.render(tmp_path, "config system\noption hostname {{ intent.hostname | uci }}\n")
        assert option(rendered, "system", "@system[0]", "hostname") == NAME
        assert option(rendered, "system", "@system[0]", "timezone") == ""
        assert option(rendered, "wireless", "mesh0", "ssid") == "fleet"

    def test_a_template_adds_a_file_that_is_not_uci(self, tmp_path: Path) -> None:
        rendered = self.render(tmp_path, "hello {{ intent.node }}\n", "batman-adv/etc/banner.j2")
        banner = rendered.file("etc/banner")
        assert banner is not None
        assert (banner.content, banner.mode, banner.package) == (b"hello husky1-front\n", 0o644, None)

    @pytest.mark.parametrize(
        ("text", "line", "words"),
        [
            (
                "config system\n\toption hostname {{ intent.hostname }}\n",
                2,
                "expected every expression to end in `| uci`",
            ),
            ("config system\n\n\toption x {{ intent.zzz | uci }}\n", 3, "Intent has no 'zzz'; it has "),
            ("config system\n\toption x {{ intent.hostnam | uci }}\n", 2, "did you mean 'hostname'?"),
            ("config system\n\toption x {{ nothing }}\n", 2, "'nothing' is undefined"),
            ("config system\n{% if %}\n", 2, "Expected an expression"),
            ("config system\n\toption x {{ '' | uci }}\n", 2, "found empty text"),
            ("config system\n\toption x {{ (1 // 0) | uci }}\n", 2, "ZeroDivisionError"),
            ("config system\n\toption x {{ [] | uci }}\n", 2, "found list"),
            ("config system\n\toption x {{ ''.__class__ | uci }}\n", 2, "is unsafe"),
            ("config system\n{% include 'gone.j2' %}\n", 0, "found none named gone.j2"),
            ("option x 'y'\n", 0, "template output is not UCI: etc/config/system:1:1"),
        ],
    )
    def test_template_errors_show_file_and_line(self, tmp_path: Path, text: str, line: int, words: str) -> None:
        with pytest.raises(InvalidInput) as caught:
            self.render(tmp_path, text)
        (finding,) = caught.value.diagnostics
        assert finding.position.file.endswith("common/etc/config/system.j2")
        assert finding.position.line == line
        assert words in str(finding)

    def test_templates_show_secrets_only_through_the_reveal_filter(self, tmp_path: Path) -> None:
        template = tmp_path / "templates/common/etc/supplicant.j2"
        template.parent.mkdir(parents=True)
        template.write_text("{{ intent.secrets[0] }} {{ intent.secrets[0] | reveal }}\n")
        fleet = fleets.fleet(meshes=(fleets.mesh(encryption=Encryption.PSK2),), base=str(tmp_path))
        rendered = render_node(fleet, NAME, fleets.secrets)
        file = rendered.file("etc/supplicant")
        assert file is not None
        assert file.content.decode() == f"{MASK} {fleets.KEY}\n"
        assert (file.masked, file.mode) == (f"{MASK} {MASK}\n", 0o600)

    def test_templates_in_an_unknown_folder_are_rejected(self, tmp_path: Path) -> None:
        with pytest.raises(InvalidInput, match="expected one of batman-adv, common, meshmerize, found batman_adv"):
            self.render(tmp_path, "config system\n", "batman_adv/etc/config/system.j2")

    def test_operator_templates_may_be_inside_the_template_folder(self, tmp_path: Path) -> None:
        own = tmp_path / "templates/ours/etc/motd.j2"
        own.parent.mkdir(parents=True)
        own.write_text("ours\n")
        parts = OperatorParts(templates="templates/ours", base=str(tmp_path))
        fleet = fleets.fleet(meshes=(fleets.mesh(operator_parts=parts),), base=str(tmp_path))
        file = render_node(fleet, NAME, fleets.secrets).file("etc/motd")
        assert file is not None
        assert file.content == b"ours\n"

    def test_the_operator_template_folder_must_exist(self, tmp_path: Path) -> None:
        mesh: Any = fleets.mesh()
        parts = replace(mesh.operator_parts, templates="none", base=str(tmp_path))
        with pytest.raises(InvalidInput, match="expected a folder of templates, found none"):
            render_node(fleets.fleet(meshes=(replace(mesh, operator_parts=parts),)), NAME, fleets.secrets)
