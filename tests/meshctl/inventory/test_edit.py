"""Edits change what they mean to, keep everything else, and are refused where they could not."""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.inventory import load_fleet
from meshctl.inventory.compose import compose
from meshctl.inventory.edit import Editor, add_topic, remove_topic, save, set_node, set_state, set_topic
from meshctl.inventory.source import Source
from meshctl.inventory.text_edit import insert_entry, remove_entry, replace_value
from meshctl.inventory.tree import MappingNode, Plain, descend, plain_data
from meshctl.inventory.yaml_text import Value, parsed_data
from meshctl.model import NodeState
from tests.meshctl.inventory.inventories import HEAD, SHIPPED


@pytest.fixture
def final(tmp_path: Path) -> Path:
    shutil.copytree(SHIPPED / "subt-final", tmp_path / "final")
    return tmp_path / "final"


def _saved(editor: Editor) -> None:
    save(editor.changes())


def _comments(text: str) -> list[str]:
    return re.findall(r"#.*", text)


def test_changing_a_state_edits_only_its_line(final: Path) -> None:
    before = (final / "fleet.yaml").read_text()
    editor = Editor.open(final)
    set_state(editor, "uav1-radio", NodeState.DEPLOYED)
    (change,) = editor.changes()
    assert change.diff().splitlines()[-7:] == [
        "     role: robot",
        "     hardware: light",
        "-    state: carried",
        "+    state: deployed",
        "     address: 10.42.0.51",
        "     label: U1",
        "     radios: {radio0: {tx_power_dbm: 24}}",
    ]
    assert (final / "fleet.yaml").read_text() == before
    save((change,))
    assert load_fleet(final).nodes["uav1-radio"].state is NodeState.DEPLOYED


def test_editing_a_node_of_a_range_adds_its_own_entry_after_the_range(final: Path) -> None:
    before = load_fleet(final)
    editor = Editor.open(final)
    set_state(editor, "husky1-b03", NodeState.LOST)
    set_state(editor, "husky1-b01", NodeState.DEPLOYED)
    set_node(editor, "husky1-b03", {"serial": "007", "mac": "02:00:00:00:00:07", "host_keys": ["ssh-ed25519 AAAA b03"]})
    _saved(editor)
    after = load_fleet(final)
    node = after.nodes["husky1-b03"]
    assert (node.state, node.serial, node.mac, node.host_keys) == (
        NodeState.LOST,
        "007",
        "02:00:00:00:00:07",
        ("ssh-ed25519 AAAA b03",),
    )
    unchanged = before.nodes.keys() - {"husky1-b03", "husky1-b01"}
    assert {name: before.nodes[name] for name in unchanged} == {name: after.nodes[name] for name in unchanged}
    assert {name: node.address for name, node in before.nodes.items()} == {
        name: node.address for name, node in after.nodes.items()
    }
    lines = (final / "fleet.yaml").read_text().splitlines()
    start = lines.index("  husky1-b[01-06]: {groups: [beacons], address: {from: 10.42.0.101}}")
    assert lines[start + 1].startswith("  husky1-b03: {state: lost, serial:")
    assert lines[start + 2] == "  husky1-b01: {state: deployed}"


def test_topics_are_edited_in_the_included_file_that_defines_them(final: Path) -> None:
    main = (final / "fleet.yaml").read_text()
    comments = _comments((final / "topics.yaml").read_text())
    editor = Editor.open(final)
    add_topic(editor, "chat", {"priority": 5, "class": "other", "reliable": False, "deadline_s": 1.5})
    set_topic(editor, "telemetry", {"rate_hz": 5, "repair": True})
    remove_topic(editor, "map_diffs")
    _saved(editor)
    topics = {topic.name: topic for topic in load_fleet(final).topics}
    assert list(topics) == ["emergency_stop", "commands", "artifacts", "telemetry", "fpv", "chat"]
    assert (topics["chat"].priority, topics["chat"].reliable, topics["chat"].deadline_s) == (5, False, 1.5)
    assert (topics["telemetry"].rate_hz, topics["telemetry"].repair) == (5, True)
    text = (final / "topics.yaml").read_text()
    assert _comments(text) == [line for line in comments if "map updates" not in line]
    assert "\n\n\n" not in text
    assert "\n\n  chat:\n    priority: 5\n" in text
    assert (final / "fleet.yaml").read_text() == main


def test_adding_existing_and_changing_missing_entries_is_rejected(final: Path) -> None:
    editor = Editor.open(final)
    acts: list[Callable[[], None]] = [
        lambda: add_topic(editor, "fpv", {"priority": 3}),
        lambda: set_topic(editor, "chat", {"priority": 3}),
        lambda: remove_topic(editor, "chat"),
        lambda: editor.set(("fleet", "name"), "x"),
        lambda: editor.set(("nodes", "base", "label", "x"), "y"),
    ]
    for act in acts:
        with pytest.raises(InputError):
            act()
    assert editor.changes() == ()


def test_a_value_that_would_not_load_is_refused_with_its_place(final: Path) -> None:
    editor = Editor.open(final)
    set_topic(editor, "fpv", {"priority": 99})
    with pytest.raises(InvalidInput, match=r"topics\.fpv\.priority: expected at most 15"):
        editor.changes()


def test_an_inventory_with_errors_is_not_edited(final: Path) -> None:
    (final / "topics.yaml").write_text("topics: {x: {}}\n")
    with pytest.raises(InvalidInput):
        Editor.open(final)


def test_an_edit_through_a_shared_alias_is_refused(tmp_path: Path) -> None:
    text = HEAD + "groups:\n  a: {radios: &r {radio0: {tx_power_dbm: 11}}}\n  b: {radios: *r}\n"
    (tmp_path / "fleet.yaml").write_text(text)
    editor = Editor.open(tmp_path)
    with pytest.raises(InputError, match="layout"):
        editor.set(("groups", "b", "radios", "radio0", "tx_power_dbm"), 12)


def test_a_file_that_changed_meanwhile_is_not_overwritten(final: Path) -> None:
    editor = Editor.open(final)
    set_state(editor, "base", NodeState.SPARE)
    changes = editor.changes()
    (final / "fleet.yaml").write_text("someone else's\n")
    with pytest.raises(InputError, match="meanwhile"):
        save(changes)
    assert (final / "fleet.yaml").read_text() == "someone else's\n"
    (final / "fleet.yaml").unlink()
    with pytest.raises(InputError, match="cannot be written"):
        save(changes)


def test_saving_preserves_mode_symlink_line_endings_and_byte_order_mark(tmp_path: Path) -> None:
    real = tmp_path / "real.yaml"
    text = HEAD + "nodes:\n  n: {hardware: rocket, address: 10.42.0.1}   # mine\n"
    real.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    real.chmod(0o640)
    (tmp_path / "fleet.yaml").symlink_to(real)
    editor = Editor.open(tmp_path)
    set_node(editor, "n", {"label": "Größe"})
    add_topic(editor, "t", {"priority": 1})
    _saved(editor)
    content = real.read_bytes()
    assert content.startswith(b"\xef\xbb\xbfmeshctl")
    assert content.count(b"\n") == content.count(b"\r\n")
    assert stat.S_IMODE(real.stat().st_mode) == 0o640
    assert (tmp_path / "fleet.yaml").is_symlink()
    assert 'label: "Größe"}   # mine' in content.decode()
    assert sorted(os.listdir(tmp_path)) == ["fleet.yaml", "real.yaml"]


_LAYOUTS = {
    "block": "nodes:\n  a:\n    label: x   # its label\n\n  b:\n    role: base\n# end\n",
    "flow": "nodes: {a: {label: x}, b: {role: base}}\n",
    "flow over lines": "nodes: {\n  a: {\n    label: x,  # its label\n  },\n  b: {role: base},\n}\n",
    "empty value": "nodes:\n  a:   # nothing yet\n  b:\n",
    "empty flow": "nodes:\n  a: {}\n  b: {}\n",
    "no end of line": "nodes:\n  a: {label: x}\n  b:\n    role: base",
    "folded": "nodes:\n  a:\n    label: >-\n      x\n\n\n  b:\n    role: base\n",
    "quoted keys": 'nodes:\n  "a":\n    \'label\': "x"\n  b: {"role": base}\n',
    "lists": "nodes:\n  a:\n    packages:\n    - one   # first\n    - two\n    label: x\n  b: {host_keys: [k]}\n",
}


@pytest.mark.parametrize("layout", _LAYOUTS)
def test_values_can_be_set_and_removed_in_every_layout(layout: str, tmp_path: Path) -> None:
    head = HEAD + "defaults: {hardware: rocket, address: {rule: network + index}}\n"
    (tmp_path / "fleet.yaml").write_text(head + _LAYOUTS[layout])
    comments = _comments(_LAYOUTS[layout])
    editor = Editor.open(tmp_path)
    set_node(editor, "a", {"state": "lost", "label": "y: z", "packages": ["p", "q r"]})
    set_node(editor, "b", {"serial": "12"})
    set_node(editor, "c", {"label": "new"})
    _saved(editor)
    fleet = load_fleet(tmp_path)
    a, b, c = (fleet.nodes[name] for name in "abc")
    assert (a.state, a.label, a.packages, b.serial, c.label) == (NodeState.LOST, "y: z", ("p", "q r"), "12", "new")
    text = (tmp_path / "fleet.yaml").read_text()
    assert [line for line in _comments(text) if line in comments] == [line for line in comments if line != "# first"]
    editor = Editor.open(tmp_path)
    editor.remove(("nodes", "c"))
    editor.remove(("nodes", "a", "state"))
    editor.remove(("nodes", "b", "serial"))
    _saved(editor)
    fleet = load_fleet(tmp_path)
    assert list(fleet.nodes) == ["a", "b"]
    assert (fleet.nodes["a"].state, fleet.nodes["b"].serial) == (NodeState.DEPLOYED, "")


def test_removing_the_last_entry_leaves_an_editable_empty_mapping(tmp_path: Path) -> None:
    for section in ("topics: {t: {priority: 1}}\n", "topics:   # none\n  t:\n    priority: 1\n"):
        (tmp_path / "fleet.yaml").write_text(HEAD + section)
        editor = Editor.open(tmp_path)
        remove_topic(editor, "t")
        _saved(editor)
        assert load_fleet(tmp_path).topics == ()
        editor = Editor.open(tmp_path)
        add_topic(editor, "u", {"priority": 2})
        _saved(editor)
        assert [topic.name for topic in load_fleet(tmp_path).topics] == ["u"]


_SCALARS: st.SearchStrategy[Value] = st.one_of(
    st.booleans(),
    st.integers(-1000, 10**9),
    st.floats(0.001, 1e6).map(lambda number: round(number, 3)),
    st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Zl", "Zp"]), max_size=12),
    st.sampled_from(
        ["yes", "null", "~", "12", "1e3", "0x10", "a: b", "a #b", "- a", "[a]", "{a}", "'", '"', "\\", "", " "]
    ),
)
_VALUES: st.SearchStrategy[Value] = st.one_of(
    _SCALARS,
    st.lists(_SCALARS, max_size=3),
    st.dictionaries(st.text("abc:#' ", min_size=1, max_size=4), _SCALARS, max_size=3),
)
_BASE = dedent("""\
    # head
    one:
      a: 1   # first

      # above b
      b: [x, "y"]
      c:
        d: deep
    two: {e: 5, f: {g: 6}}
    """)
_PATHS = st.sampled_from(
    [("one", "a"), ("one", "b"), ("one", "c"), ("one", "c", "d"), ("two", "e"), ("two", "f"), ("two", "f", "g")]
)


def _root(text: str) -> MappingNode:
    composed = compose(Source("t.yaml", text))
    assert composed.diagnostics == ()
    assert isinstance(composed.root, MappingNode)
    return composed.root


def _texts(value: object) -> object:
    """Without the difference between quoted and plain, except where it decides what a value is."""
    if isinstance(value, dict):
        return {key: _texts(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_texts(item) for item in value]
    return str(value) if isinstance(value, Plain) else value


@given(path=_PATHS, value=_VALUES)
@settings(max_examples=150)
def test_a_replaced_value_round_trips_and_leaves_other_values_unchanged(path: tuple[str, ...], value: Value) -> None:
    root = _root(_BASE)
    old, parent = descend(root, path), descend(root, path[:-1])
    assert old is not None
    assert isinstance(parent, MappingNode)
    text = replace_value(_BASE, old, value, parent.keys[path[-1]])
    after = _root(text)
    found = descend(after, path)
    assert found is not None
    assert _texts(plain_data(found)) == _texts(parsed_data(value))
    assert _comments(text)[:1] == ["# head"]
    for other in ("one", "two"):
        if other != path[0]:
            assert plain_data(after.values[other]) == plain_data(root.values[other])


@given(
    section=st.sampled_from([("one",), ("one", "c"), ("two",), ("two", "f")]),
    key=st.text("klm-", min_size=1, max_size=5),
    value=_VALUES,
)
@settings(max_examples=150)
def test_an_inserted_entry_reads_back_and_its_removal_restores_the_text(
    section: tuple[str, ...], key: str, value: Value
) -> None:
    root = _root(_BASE)
    mapping = descend(root, section)
    assert isinstance(mapping, MappingNode)
    text = insert_entry(_BASE, mapping, key, value)
    after = descend(_root(text), section)
    assert isinstance(after, MappingNode)
    assert _texts(plain_data(after.values[key])) == _texts(parsed_data(value))
    assert list(after.keys) == [*mapping.keys, key]
    assert remove_entry(text, after, key) == _BASE


@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from(["base", "husky1-front", "husky1-b02", "husky2-b06", "new"]),
            st.sampled_from(list(NodeState)),
        ),
        max_size=5,
    )
)
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_series_of_state_changes_keeps_comments_and_the_last_state_wins(
    steps: list[tuple[str, NodeState]], tmp_path: Path
) -> None:
    target = tmp_path / "run"
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(SHIPPED / "subt-final", target)
    editor = Editor.open(target)
    set_node(editor, "new", {"hardware": "rocket", "address": "10.42.0.99"})
    for node, state in steps:
        set_state(editor, node, state)
    _saved(editor)
    fleet = load_fleet(target)
    assert {name: fleet.nodes[name].state for name in dict(steps)} == dict(steps)
    before = (SHIPPED / "subt-final" / "fleet.yaml").read_text()
    assert _comments((target / "fleet.yaml").read_text()) == _comments(before)


_ENTRIES = [
    "  a:\n    label: x\n    packages:\n      - p   # why\n      - q\n",
    "  b: {label: y, mac: 02:00:00:00:00:00}\n",
    "  c:\n",
    "  d: {\n    label: z, # c\n  }\n",
    "  ? e\n",
    "  ? f\n  :\n    label: q\n",
    "  g[1-3]: {}\n",
    "  'h' : {label: a}\n",
    "  i: &n {label: w}\n  j: *n\n",
    "  k:\n    label: |\n      text\n\n",
    "  l:\n    label: >+\n      text\n\n\n",
    "  m: {packages: [a, b,], }\n",
    "  # between\n",
    "\n",
    "  n:\n    label: 'it''s'\n    # tail\n",
    "  o:\n    label: two\n      lines\n    state: lost\n",
]
_STEPS = st.tuples(
    st.sampled_from(["a", "b", "c", "d", "e", "f", "g1", "h", "i", "j", "k", "l", "m", "n", "o", "new"]),
    st.sampled_from(["label", "packages", "state", "-label", "-packages", "-"]),
)


@given(
    entries=st.lists(st.sampled_from(_ENTRIES), unique=True, min_size=1, max_size=8),
    steps=st.lists(_STEPS, min_size=1, max_size=5),
    tail=st.sampled_from(["", "\n  ", "topics: {}\n"]),
)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_an_edit_in_any_layout_is_applied_correctly_or_rejected(
    entries: list[str], steps: list[tuple[str, str]], tail: str, tmp_path: Path
) -> None:
    head = HEAD + "defaults: {hardware: rocket, address: 10.42.0.1}\nnodes:\n"
    (tmp_path / "fleet.yaml").write_text(head + "".join(entries) + tail)
    editor = Editor.open(tmp_path)
    meant = dict(load_fleet(tmp_path).nodes)
    new: dict[str, Value] = {"label": "n: w", "packages": ["r"], "state": "spare"}
    for node, what in steps:
        before = editor.changes()
        try:
            if what == "-":
                editor.remove(("nodes", node))
            elif what.startswith("-"):
                editor.remove(("nodes", node, what[1:]))
            else:
                set_node(editor, node, {what: new[what]})
        except InputError:
            assert editor.changes() == before
            continue
        _saved(editor)
        editor = Editor.open(tmp_path)
        after = load_fleet(tmp_path).nodes
        # Nothing but the one node may differ.
        assert {name: after[name] for name in after if name != node} == {
            name: meant[name] for name in meant if name != node
        }
        if not what.startswith("-"):
            assert getattr(after[node], what) in ("n: w", ("r",), NodeState.SPARE)
        meant = dict(after)


@given(
    entries=st.lists(st.sampled_from(_ENTRIES), unique=True, max_size=8),
    values=st.dictionaries(
        st.sampled_from([*"abcdefhijklmno", "g1", "g2", "new1", "new2"]),
        st.fixed_dictionaries({"label": st.just("n: w")}, optional={"state": st.just("spare")}),
        max_size=6,
    ),
    tail=st.sampled_from(["", "\n  ", "topics: {}\n"]),
)
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(entries=["  l:\n    label: >+\n      text\n\n\n"], values={key: {"label": "n: w"} for key in "la"}, tail="")
def test_many_nodes_are_set_as_one_after_the_other(
    entries: list[str], values: dict[str, dict[str, Value]], tail: str, tmp_path: Path
) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(HEAD + "defaults: {hardware: rocket, address: 10.42.0.1}\nnodes:\n" + "".join(entries) + tail)
    singly, together = Editor.open(tmp_path), Editor.open(tmp_path)
    try:
        for node, fields in values.items():
            set_node(singly, node, fields)
    except InputError:
        return
    together.set_nodes(values)
    assert plain_data(together._roots[path]) == plain_data(singly._roots[path])
