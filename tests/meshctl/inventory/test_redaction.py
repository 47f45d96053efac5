"""What findings show of an inventory's text: the line and its place, and no secret, wherever one was written."""

from __future__ import annotations

from textwrap import dedent

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.inventory.redaction import Excerpts
from meshctl.resources import shipped

MESH = "meshes:\n  main:\n    ssid: team   # our own\n    {}\n"


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("channel: 6", "channel: 6"),
        ("channel: 6   # the quiet one", "channel: 6   # the quiet one"),
        ("key: HUNTER2", "key: ***"),
        ('key: "HUNTER2 and more"   # mine', "key: ***   #***"),
        ("key: {env: MESH_KEY}", "key: {env: MESH_KEY}"),
        ("key: {file: ../secrets.yaml, key: mesh}", "key: {file: ../secrets.yaml, key: mesh}"),
        ("key: {env: HUNTER2-inline}", "key: {env: ***}"),
        ("key: {evn: HUNTER2}", "key: {evn: ***}"),
        ("keey: HUNTER2", "keey: ***"),
        ("psk: HUNTER2", "psk: ***"),
        ("ssid_: [HUNTER2, {a: HUNTER2}]", "ssid_: [***, {a: ***}]"),
        ("channel: 6   # psk: HUNTER2", "channel: 6   #***"),
        ("channel: [6, HUNTER2", "channel: [***, ***"),
        ("batman: HUNTER2", "batman: ***"),
    ],
)
def test_a_line_shows_known_values_and_masks_secrets(line: str, shown: str) -> None:
    found = Excerpts(MESH.format(line)).line(4, 5)
    assert found == (f"    {shown}", 5)


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("  other: {<<: *shared, ssid: x}", "  other: {<<: *shared, ssid: x}"),
        ("    <<: *shared", "    <<: *shared"),
        ("    ssid: HUNTER2", "    ssid: ***"),
        ("    key: HUNTER2", "    key: ***"),
        ("    HUNTER2: HUNTER2", "    ***: ***"),
    ],
)
def test_keys_that_are_refused_are_shown_and_their_values_masked(line: str, shown: str) -> None:
    """A merge key, or one that is there twice: the excerpt of such a finding was `***: ***`."""
    text = f"meshes:\n  a: &shared {{ssid: a}}\n  b:\n    key: {{env: KEY}}\n    ssid: b\n    HUNTER2: 1\n{line}\n"
    assert Excerpts(text).line(7, 0) == (shown, 0)


@pytest.mark.parametrize(
    "text",
    [
        "mesh: HUNTER2\nudp:\n  - HUNTER2\n",
        "HUNTER2\n",
        "- HUNTER2\n",
        "root:HUNTER2:20228:0:99999:7:::\ndaemon:HUNTER2:1::\n",
        "key: |\n  HUNTER2\n  HUNTER2\n",
        "udp_mesh:\n  keys:\n    - HUNTER2\n    - {env: HUNTER-2-HUNTER2}\n",
        "extra_uci: {wireless.default_radio0.key: HUNTER2}\n",
        "defaults: {extra_uci: {wireless.default_radio0.key: HUNTER2}}\n",
        "mesh: HUNTER2\nmesh: HUNTER2\n",
        "# token: HUNTER2\ncountry: US\n",
        "mesh: x # HUNTER2\n",
        'key: "HUNTER2\n',
        "[core]\n\textraheader = AUTHORIZATION: basic HUNTER2\n",
        "\ufeffkey: HUNTER2\r\nkey: HUNTER2\r\n",
    ],
)
def test_no_excerpt_shows_a_secret(text: str) -> None:
    excerpts = Excerpts(text)
    lines = [excerpts.line(number, 1) for number in range(1, text.count("\n") + 2)]
    assert not [line for line in lines if line is not None and "HUNTER2" in line[0]]


def test_the_column_is_adjusted_for_masked_text() -> None:
    text = "nodes: {b03: {pass: HUNTER2HUNTER2, address: 10.42.0.1}}\n"
    column = text.index("10.42") + 1
    found = Excerpts(text).line(1, column)
    assert found is not None
    line, place = found
    assert "HUNTER2" not in line
    assert line[place - 1 :].startswith("10.42.0.1")


@pytest.mark.parametrize("name", ["lab", "starter", "subt-final"])
def test_the_shipped_inventories_are_shown_unmasked(name: str) -> None:
    text = (shipped("inventory") / name / "fleet.yaml").read_text(encoding="utf-8")
    excerpts = Excerpts(text)
    changed = [
        (number, line)
        for number, line in enumerate(text.split("\n"), 1)
        if excerpts.line(number, 0) != (line.rstrip(), 0) and not line.lstrip().startswith("#")
    ]
    assert [line for _, line in changed if "ssh-" not in line and "AAAA" not in line] == []


@given(st.text(), st.integers(1, 5), st.integers(0, 50))
def test_arbitrary_text_yields_excerpts_with_valid_columns(text: str, number: int, column: int) -> None:
    found = Excerpts(text).line(number, column)
    assert found is None or found[1] <= len(found[0]) + 1


def test_names_of_anchors_are_shown_where_an_alias_uses_them() -> None:
    text = dedent(
        """\
        defaults: &common {hardware: rocket}
        groups:
          first: &relay
            role: beacon
          second: *relay
        nodes:
          b0: *common
          b1: {address: &start 10.42.0.1}
          b2: {address: *start}
          b3: {mesh: &hunter2 x}
        meshes:
          main: {key: &hunter3 hunter4}
          other: {key: *hunter3}
        """
    )
    excerpts = Excerpts(text)
    shown = [found[0] for number in range(1, 14) if (found := excerpts.line(number, 1)) is not None]
    assert shown[:9] == text.splitlines()[:9]
    assert "hunter" not in "".join(shown)
