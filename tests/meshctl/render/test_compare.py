"""Two fleets side by side: what changes on which node, and nothing else."""

from __future__ import annotations

from dataclasses import replace

from meshctl.model import MASK, Encryption, MeshMode, NodeState, Release, SecretKind, SecretRef
from meshctl.render import render_node
from meshctl.render.compare import NodeChange, compare_files, compare_fleets, compare_nodes
from tests.meshctl.render import fleets

FLEET = fleets.fleet(fleets.node(name="a"), fleets.node(name="b"))


def test_a_fleet_has_no_differences_from_itself() -> None:
    assert list(compare_fleets(FLEET, FLEET)) == []


def test_each_changed_option_is_named_on_each_node() -> None:
    after = replace(FLEET, meshes={"main": fleets.mesh(channel=11)})
    differences = list(compare_fleets(FLEET, after))
    assert [(item.node, item.change) for item in differences] == [("a", NodeChange.CHANGED), ("b", NodeChange.CHANGED)]
    (file,) = differences[0].files
    assert (file.path, file.lines) == ("etc/config/wireless", ("~ wireless.radio0.channel: '6' -> '11'",))


def test_new_and_lost_nodes_are_reported() -> None:
    after = fleets.fleet(fleets.node(name="a", state=NodeState.LOST), fleets.node(name="b"), fleets.node(name="c"))
    differences = [(item.node, item.change) for item in compare_fleets(FLEET, after)]
    assert differences == [("a", NodeChange.REMOVED), ("c", NodeChange.ADDED)]


def test_keys_are_compared_by_reference_and_masked() -> None:
    sae = fleets.mesh(mode=MeshMode.MESH, encryption=Encryption.SAE)
    before = fleets.fleet(meshes=(sae,))
    after = fleets.fleet(meshes=(replace(sae, key=SecretRef(SecretKind.ENV, "OTHER_KEY")),))
    assert list(compare_fleets(before, before)) == []
    (difference,) = compare_fleets(before, after)
    assert difference.files[0].lines == (f"~ wireless.mesh0.key: {MASK} -> {MASK}",)


def test_packages_and_releases_are_compared() -> None:
    after = fleets.fleet(fleets.node(Release.V24_10, packages=("tcpdump",)))
    (difference,) = compare_fleets(fleets.fleet(), after)
    assert difference.release == ("23.05", "24.10")
    assert difference.packages_added == ("tcpdump",)
    assert difference.packages_removed == ()


def test_non_uci_files_are_compared_by_line() -> None:
    after = fleets.fleet(operators=replace(FLEET.operators, ssh_keys=(fleets.RSA,)))
    (difference,) = compare_fleets(fleets.fleet(), after)
    (file,) = difference.files
    assert file.path == "etc/dropbear/authorized_keys"
    assert file.lines[1:] == (f" {fleets.RSA}", f"-{fleets.ED25519}")


def test_new_files_are_reported() -> None:
    after = fleets.fleet(fleets.node(extra_uci={"lldpd.config": "lldpd", "lldpd.config.lldp_class": "4"}))
    (difference,) = compare_fleets(fleets.fleet(), after)
    (file,) = difference.files
    assert (file.path, file.change) == ("etc/config/lldpd", NodeChange.ADDED)
    assert file.lines == ("+ lldpd.config (lldpd)", "+ lldpd.config.lldp_class: (none) -> '4'")
    (back,) = compare_fleets(after, fleets.fleet())
    assert back.files[0].lines == ("- lldpd.config (lldpd)",)


def test_a_key_is_masked_in_any_option() -> None:
    fleet = fleets.fleet(
        fleets.node(label=f"the key is {fleets.KEY}"), meshes=(fleets.mesh(encryption=Encryption.PSK2),)
    )
    old = render_node(fleet, "husky1-front", fleets.secrets)
    new = render_node(replace(fleet, nodes={"husky1-front": fleets.node(label="x")}), "husky1-front", fleets.secrets)
    lines = list(compare_files(old.file("etc/config/system"), new.file("etc/config/system")))
    assert f"~ system.@system[0].description: 'the key is {MASK}' -> 'x'" in lines
    assert "mode 0600 -> 0644" in lines


def test_comparing_nothing_with_nothing_gives_no_difference() -> None:
    assert compare_nodes(None, None) is None
    assert list(compare_files(None, None)) == []
