"""Whatever is wrong has a code, a file, a line and a column; all of it is reported, and nothing raises."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from pydantic_core import ErrorDetails

from meshctl.inventory import load
from meshctl.inventory.codes import MAX_DIAGNOSTICS, MEANINGS
from meshctl.inventory.documents.base import Document
from meshctl.inventory.source import MAX_FILE_BYTES
from meshctl.inventory.validate import expected_value
from tests.meshctl.inventory.inventories import HEAD, errors_of, load_text

_BOMB = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 10)}]\n" for i in range(12)
)

# name -> text, code, line, column
_WHOLE_FILES = {
    "empty": ("", "INV009", 1, 1),
    "only a comment": ("# nothing\n", "INV009", 1, 1),
    "null": ("~\n", "INV009", 1, 1),
    "a text": ("fleet\n", "INV021", 1, 1),
    "a list": ("- fleet\n", "INV021", 1, 1),
    "two documents": ("meshctl: 1\n---\nfleet: f\n", "INV005", 2, 1),
    "duplicate key": ("fleet: a\nmeshctl: 1\nfleet: b\n", "INV006", 3, 1),
    "duplicate key deep down": ("system: {log_port: 1, log_port: 2}\n", "INV006", 1, 23),
    "merge key": ("defaults: &d {}\nnodes: {n: {<<: *d}}\n", "INV005", 2, 13),
    "python tag": ("fleet: !!python/object/apply:os.system [id]\n", "INV005", 1, 8),
    "binary tag": ("fleet: !!binary aGk=\n", "INV005", 1, 8),
    "tab": ("system:\n\tlog_port: 1\n", "INV004", 2, 1),
    "unclosed bracket": ("include: [a\n", "INV004", 1, 10),
    "control character": ("fleet: a\x07b\n", "INV003", 1, 9),
    "deep nesting": ("[" * 100_000, "INV008", 1, 33),
    "deep blocks": ("".join(" " * depth + "a:\n" for depth in range(100)), "INV008", 33, 33),
    # libyaml 0.2.6 stops at 1,000 levels itself
    "deepest blocks": ("".join(" " * depth + "a:\n" for depth in range(1_500)), "INV008", 33, 33),
    "deep lists": ("- " * 5_000, "INV008", 1, 65),
    "deep nesting below keys": ("a: " + "{a: " * 5_000, "INV008", 1, 128),
    "alias bomb": (_BOMB, "INV007", 5, 4),
    "alias in itself": ("a: &a [*a]\n", "INV005", 1, 8),
    "alias of nothing": ("a: *b\n", "INV005", 1, 4),
    "list as a key": ("? [a]\n: b\n", "INV005", 1, 3),
    "includes itself": ("include: [fleet.yaml]\n", "INV010", 1, 11),
    "includes nothing": ("include:\n  - gone.yaml\n", "INV001", 2, 5),
    "includes a directory": ("include: [.]\n", "INV001", 1, 11),
    "include with NUL": ('include: ["a\\0b"]\n', "INV010", 1, 11),
}


def test_keys_that_a_merge_key_was_to_bring_are_not_also_missing(tmp_path: Path) -> None:
    found = load_text(tmp_path, HEAD + "topics:\n  a: &a {priority: 1}\n  b: {<<: *a}\n  c: {}\n").diagnostics
    problems = [(item.code, item.path) for item in found if item.path.startswith("topics") or item.code == "INV005"]
    assert sorted(problems) == [("INV005", ""), ("INV022", "topics.c")]


@pytest.mark.parametrize("name", _WHOLE_FILES)
def test_an_invalid_inventory_file_is_rejected_with_its_location(name: str, tmp_path: Path) -> None:
    text, code, line, column = _WHOLE_FILES[name]
    loaded = load_text(tmp_path, text)
    assert loaded.fleet is None
    first = next(item for item in loaded.diagnostics if item.code == code)
    assert (first.position.line, first.position.column) == (line, column)
    assert first.position.file == str(tmp_path / "fleet.yaml")


# name -> text after HEAD (13 lines), code, line below HEAD, what the message must say
_PARTS = {
    "unknown key": ("aply: {}\n", "INV020", 1, "unknown key 'aply'"),
    "unknown key in a node": ("nodes:\n  n: {hardwear: rocket}\n", "INV020", 2, "unknown key 'hardwear'"),
    "wrong kind": ("apply: []\n", "INV021", 1, "expected a mapping, found a list"),
    "text for a number": ("system: {log_port: high}\n", "INV021", 1, "expected a whole number, found 'high'"),
    "quoted number": ('system: {log_port: "514"}\n', "INV021", 1, 'found "514" in quotes'),
    "fraction": ("system: {log_port: 1.5}\n", "INV021", 1, "expected a whole number"),
    "huge number": ("system: {log_port: " + "9" * 5000 + "}\n", "INV021", 1, "expected a whole number"),
    "not a number": ("apply: {quorum: .nan}\n", "INV021", 1, "expected a number"),
    "infinite": ("apply: {quorum: 1e999}\n", "INV021", 1, "expected a number"),
    "above the bound": ("topics: {t: {priority: 16}}\n", "INV021", 1, "expected at most 15, found '16'"),
    "wrong word": ("topics: {t: {priority: 1, class: vidoe}}\n", "INV021", 1, "found 'vidoe'"),
    "delta that is no flag": ("topics:\n  t:\n    delta: 5\n", "INV021", 3, "expected true or false, found '5'"),
    "no bytes for delta": ("topics: {t: {delta_bytes: 0}}\n", "INV021", 1, "expected at least 1, found '0'"),
    "delta_bytes above what the daemon accepts": (
        "topics:\n  t:\n    delta: true\n    delta_bytes: 1073741825\n",
        "INV021",
        4,
        "topics.t.delta_bytes: expected at most 1073741824, found '1073741825'",
    ),
    "a unit in delta_bytes": (
        "topics: {t: {delta_bytes: 16 MiB}}\n",
        "INV021",
        1,
        "expected a whole number, found '16 MiB'",
    ),
    "missing key": ("topics: {t: {rate_hz: 1}}\n", "INV022", 1, "topics.t: missing key 'priority'"),
    "nothing where a value belongs": ("system:\n  timezone:\n", "INV021", 2, "expected text, found nothing"),
    "bad network": ("meshes: {}\n", "INV006", 1, "duplicate key 'meshes'"),
    "bad node name": ("nodes:\n  a/b: {}\n", "INV030", 2, "is not a name"),
    "range backwards": ("nodes:\n  b[9-1]: {}\n", "INV030", 2, "descending span"),
    "endless range": ("nodes:\n  b[1-999999999]: {}\n", "INV030", 2, "expands to 999999999 names"),
    "endless product": ("nodes:\n  b[1-9999][1-9999]: {}\n", "INV030", 2, "expands to more than"),
    "half a range": ("nodes:\n  'b[1-2': {}\n", "INV030", 2, "unbalanced brackets"),
    "range in a robot": ("robots: {r: {carries: ['b[x y]']}}\n", "INV030", 1, "robots.r.carries"),
    "two ranges": ("nodes:\n  b[1-3]: {}\n  b[3-4]: {}\n", "INV031", 3, "node 'b3' is also in range 'b[1-3]'"),
    "unknown group": (
        "groups: {beacon: {}}\nnodes: {n: {groups: [beacons]}}\n",
        "INV032",
        2,
        "unknown group 'beacons'",
    ),
    "unknown parent": ("groups: {a: {inherits: [b]}}\n", "INV032", 1, "groups.a.inherits: unknown group 'b'"),
    "own parent": ("groups: {a: {inherits: [a]}}\n", "INV033", 1, "a -> a"),
    "circle": (
        "groups: {a: {inherits: [b]}, b: {inherits: [c]}, c: {inherits: [a]}}\n",
        "INV033",
        1,
        "a -> b -> c -> a",
    ),
    "no hardware": ("nodes: {n: {address: 10.42.0.1}}\n", "INV034", 1, "the node has no hardware"),
    "unknown hardware": (
        "nodes: {n: {hardware: rockt, address: 10.42.0.1}}\n",
        "INV034",
        1,
        "unknown hardware 'rockt'",
    ),
    "unknown radio": (
        "nodes: {n: {hardware: rocket, address: 10.42.0.1, radios: {radio1: {}}}}\n",
        "INV035",
        1,
        "expected one of radio0",
    ),
    "no address": ("nodes: {n: {hardware: rocket}}\n", "INV036", 1, "the node has no address"),
    "bad address": ("nodes: {n: {address: 10.42.0.256}}\n", "INV021", 1, "expected an IP address"),
    "bad rule": ("nodes: {n: {address: {rule: index + index}}}\n", "INV021", 1, "expected a sum such as"),
    "rule leaves IPv4": (
        "nodes: {'n[1-2]': {hardware: rocket, address: {from: 255.255.255.255}}}\n",
        "INV036",
        1,
        "exceeds the address range at index 2",
    ),
    "bad MAC": ("nodes: {n: {mac: 02:00:00:00:00}}\n", "INV021", 1, "expected a MAC address"),
    "unknown role": (
        "nodes: {n: {role: relay}}\n",
        "INV021",
        1,
        "expected one of 'base', 'robot', 'beacon', found 'relay'",
    ),
    "label of two lines": ('nodes: {n: {label: "B\\n3"}}\n', "INV021", 1, "nodes.n.label: expected text on one line"),
    "group in a group": ("groups: {a: {groups: [b]}}\n", "INV020", 1, "unknown key 'groups'"),
    "inherits in a node": ("nodes: {n: {inherits: [b]}}\n", "INV020", 1, "unknown key 'inherits'"),
}


@pytest.mark.parametrize("name", _PARTS)
def test_an_invalid_value_is_reported_with_its_line_and_what_was_expected(name: str, tmp_path: Path) -> None:
    text, code, line, message = _PARTS[name]
    found = [item for item in errors_of(tmp_path, text) if item.code == code]
    assert found
    assert message in found[0].text
    assert found[0].position.line == HEAD.count("\n") + line
    assert found[0].position.column > 0


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("aply: {}\n", "apply"),
        ("nodes: {n: {hardwear: rocket}}\n", "hardware"),
        ("nodes: {n: {radios: {radio0: {tx_power: 3}}}}\n", "tx_power_dbm"),
        ("topics: {t: {priority: 1, calss: video}}\n", "class"),
        ("topics: {t: {priority: 1, class: vidoe}}\n", "video"),
        ("topics: {t: {priority: 1, delta_byte: 5}}\n", "delta_bytes"),
        ("udp_mesh: {keys: [{evn: A}]}\n", "env"),
        ("udp-mesh: {}\n", "udp_mesh"),
        ("groups: {beacon: {}}\nnodes: {n: {groups: [beacons]}}\n", "beacon"),
        ("nodes: {n: {hardware: rockt, address: 10.42.0.1}}\n", "rocket"),
    ],
)
def test_a_misspelled_name_gets_a_did_you_mean_hint(text: str, meant: str, tmp_path: Path) -> None:
    assert any(item.hint == f"did you mean '{meant}'?" for item in errors_of(tmp_path, text))


def test_every_error_is_reported_and_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = """\
        system: {log_port: a, log_size_kib: b}
        nodes:
          x: {rol: base}
          y: {state: gone}
        topics: {t: {}}
        """
    found = errors_of(tmp_path, text)
    assert [item.path for item in found] == [
        "system.log_port",
        "system.log_size_kib",
        "nodes.x.rol",
        "nodes.y.state",
        "topics.t",
    ]


def test_an_error_in_a_range_is_reported_once_for_all_its_nodes(tmp_path: Path) -> None:
    found = errors_of(tmp_path, "nodes: {'b[0001-5000]': {hardware: rockt, address: {from: 10.42.0.1}}}\n")
    assert [item.code for item in found] == ["INV034"]


def test_each_inheritance_cycle_is_reported_once_and_affects_only_its_own_nodes(tmp_path: Path) -> None:
    text = """\
        groups:
          a: {inherits: [b]}
          b: {inherits: [a]}
          c: {inherits: [c]}
          d: {inherits: [a]}
        nodes:
          n: {groups: [d]}
          m: {hardware: rocket}
        """
    found = errors_of(tmp_path, text)
    assert sorted((item.code, item.path) for item in found) == [
        ("INV033", "groups.a.inherits"),
        ("INV033", "groups.c.inherits"),
        ("INV036", "nodes.m"),
    ]


def test_files_that_include_each_other_are_named(tmp_path: Path) -> None:
    found = errors_of(tmp_path, "include: [a.yaml]\n", a="include: [b.yaml]\n", b="include: [a.yaml]\n")
    assert any("a.yaml -> b.yaml -> a.yaml" in item.message for item in found)
    assert found[0].position.file.endswith("b.yaml")


def test_a_file_included_twice_is_refused(tmp_path: Path) -> None:
    found = errors_of(tmp_path, "include: [a.yaml, a.yaml]\n", a="topics: {}\n")
    assert [item.code for item in found] == ["INV010"]


def test_a_key_in_two_files_names_both_places(tmp_path: Path) -> None:
    found = errors_of(tmp_path, "include: [a.yaml]\ntopics: {t: {priority: 1}}\n", a="topics: {t: {priority: 2}}\n")
    assert found[0].code == "INV011"
    assert found[0].position.file == str(tmp_path / "a.yaml")
    assert str(tmp_path / "fleet.yaml") in found[0].found


def test_an_error_in_an_included_file_is_located_in_that_file(tmp_path: Path) -> None:
    found = errors_of(tmp_path, "include: [a.yaml]\n", a="\ntopics: {t: {priority: x}}\n")
    assert (found[0].position.file, found[0].position.line) == (str(tmp_path / "a.yaml"), 2)


def test_syntax_errors_of_all_files_are_reported_together(tmp_path: Path) -> None:
    found = errors_of(tmp_path, "include: [a.yaml, b.yaml]\n", a="x: [\n", b="y: {\n")
    assert {Path(item.position.file).name for item in found} == {"a.yaml", "b.yaml"}


@pytest.mark.parametrize("content", [b"fleet: \xff\n", b"a: 1\nb: \xc3\n"])
def test_bytes_that_are_not_utf8_are_located(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_bytes(content)
    (problem,) = load(tmp_path).diagnostics
    assert problem.code == "INV003"
    assert problem.position.line == content[: content.rfind(b":")].count(b"\n") + 1
    assert problem.found.startswith("the byte 0x")


def test_missing_files_and_invalid_paths_are_errors(tmp_path: Path) -> None:
    for path in (tmp_path / "gone.yaml", tmp_path, tmp_path / ("x" * 5000), Path("a\0b")):
        (problem,) = load(path).diagnostics
        assert problem.code == "INV001"
        assert problem.hint


def test_a_file_that_may_not_be_read_is_an_error(tmp_path: Path) -> None:
    def forbidden(path: Path) -> bytes:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)

    (problem,) = load(tmp_path / "fleet.yaml", read=forbidden).diagnostics
    assert (problem.code, "Permission denied" in problem.message) == ("INV001", True)


def test_an_endless_file_is_read_no_further_than_its_limit() -> None:
    (problem,) = load(Path("/dev/zero")).diagnostics
    assert problem.code == "INV002"
    assert str(MAX_FILE_BYTES) in problem.expected


def test_the_number_of_reported_errors_is_limited(tmp_path: Path) -> None:
    found = errors_of(tmp_path, "".join(f"key{number}: 1\n" for number in range(2 * MAX_DIAGNOSTICS)))
    assert len(found) == MAX_DIAGNOSTICS + 1
    assert sum(item.code == "INV099" for item in found) == 1
    found = errors_of(tmp_path, "a: 1\n" * 2 * MAX_DIAGNOSTICS)
    assert len(found) == MAX_DIAGNOSTICS + 1


def test_messages_are_single_line_without_control_characters(tmp_path: Path) -> None:
    text = '"\\e[31mred\\n": 1\nnodes: {"\\e[2J": {}}\ntopics: {t: {priority: "\\e[31m"}}\n'
    for item in errors_of(tmp_path, text):
        assert str(item).isprintable()


def test_every_code_has_a_meaning() -> None:
    assert all(text.endswith(".") for text in MEANINGS.values())


def test_the_rest_of_an_unquoted_text_with_commas_gets_a_hint(tmp_path: Path) -> None:
    (rest, _) = errors_of(tmp_path, "system: {timezone: MST7MDT,M3.2.0,M11.1.0}\n")
    assert "quote the whole text" in rest.hint
    # a key without a value of its own kind
    (first,) = errors_of(tmp_path, "system: {M3.2.0, timezone: UTC}\n")
    assert "known keys" in first.hint


def test_a_misspelled_key_that_is_required_is_one_error(tmp_path: Path) -> None:
    (found,) = errors_of(tmp_path, "topics:\n  t: {priorty: 3, rate_hz: 1}\n")
    assert (found.code, found.hint) == ("INV020", "did you mean 'priority'?")
    # another unknown key explains no missing one
    assert [item.code for item in errors_of(tmp_path, "topics: {t: {colour: red}}\n")] == ["INV022", "INV020"]


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("udp_mesh: {offline_after_s: 2min}", "write the number alone; it is in seconds"),
        ("apply: {quorum: 80 percent}", ""),
        ("defaults: {radios: {radio0: {tx_power_dbm: 500 mW}}}", "write the number alone; it is in dBm"),
        ("topics: {t: {priority: 1, size_bytes: 16MiB}}", "write the number alone; it is in bytes"),
        ("topics: {t: {priority: 1, rate_limit_bytes_per_s: 20 kB/s}}", "it is in bytes per second"),
        ("topics: {t: {priority: 1, deadline_s: soon}}", ""),
    ],
)
def test_a_number_with_a_unit_gets_a_hint(text: str, hint: str, tmp_path: Path) -> None:
    found = [item for item in errors_of(tmp_path, text + "\n") if "number" in item.expected]
    assert len(found) == 1
    assert hint in found[0].hint
    assert bool(hint) == bool(found[0].hint)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("udp_mesh: {keys: [{env: $MESH_KEY}]}", "the name of an environment variable such as MESH_KEY"),
        ("udp_mesh: {keys: [{env: 9}, {file: x}]}", "the name of an environment variable such as MESH_KEY"),
    ],
)
def test_what_is_expected_is_said_in_words(text: str, expected: str, tmp_path: Path) -> None:
    assert [item.expected for item in errors_of(tmp_path, text + "\n")] == [expected]


def test_no_message_shows_a_regular_expression() -> None:
    fields = [field for model in Document.__subclasses__() for field in model.model_fields.values()]
    patterns = {item.pattern for field in fields for item in field.metadata if getattr(item, "pattern", None)}
    assert len(patterns) > 3
    for pattern in patterns:
        error = ErrorDetails(type="string_pattern_mismatch", loc=(), msg="", input="", ctx={"pattern": pattern})
        assert "^" not in expected_value(error)


def test_a_network_without_its_prefix_length_is_refused(tmp_path: Path) -> None:
    text = HEAD.replace("10.42.0.0/24", "10.42.0.0")
    assert text != HEAD
    (found,) = load_text(tmp_path, text).diagnostics
    assert "expected a network with its prefix length" in found.text


@pytest.mark.parametrize(("network", "address"), [("fd42::/64", "10.42.0.1"), ("10.42.0.0/24", "fd42::1")])
def test_a_node_s_address_of_another_ip_version_than_its_mesh_loads(network: str, address: str, tmp_path: Path) -> None:
    """MC202 reports it."""
    text = HEAD.replace("10.42.0.0/24", network)
    loaded = load_text(tmp_path, text + f"nodes: {{n: {{hardware: rocket, address: '{address}'}}}}\n")
    assert loaded.fleet is not None
    interface = loaded.fleet.nodes["n"].address
    assert interface.network.num_addresses == 1


@pytest.mark.parametrize("target", ["/etc/shadow", "/dev/zero", "outside.yaml"])
def test_an_inventory_that_leads_out_of_its_tree_is_refused_unread(target: str, tmp_path: Path) -> None:
    (tmp_path / "outside.yaml").write_text("root:$y$hash:1: {}\n", encoding="utf-8")
    checkout = tmp_path / "checkout"
    (checkout / ".git").mkdir(parents=True)
    (checkout / "fleet.yaml").symlink_to(tmp_path / target)
    for path in (checkout, checkout / "fleet.yaml"):
        (problem,) = load(path).diagnostics
        assert (problem.code, problem.position.line) == ("INV001", 0)
        assert problem.message == f"cannot be read: outside the inventory's tree {checkout}"
    allowed = load(checkout, environ={"MESHCTL_INCLUDE_PATH": str(tmp_path)}).diagnostics
    assert (allowed[0].code == "INV001") == (target != "outside.yaml")


def test_a_pipe_in_the_inventory_s_directory_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fleet.yaml")
    (problem,) = load(tmp_path).diagnostics
    assert problem.message == "cannot be read: not a regular file (a pipe, socket or device)"


@pytest.mark.parametrize("text", ["a:\n    text words\n  b: 1\n", "a: >-\n    some text\n  b: 1\n"])
def test_a_syntax_error_that_is_noticed_late_points_above(text: str, tmp_path: Path) -> None:
    assert errors_of(tmp_path, text)[0].hint.startswith("the mistake may be above")


def test_what_is_wrong_with_an_address_rule_is_reported_once_for_all_its_nodes(tmp_path: Path) -> None:
    text = "nodes:\n  n[01-39]: {hardware: rocket, radios: {radio0: {mesh: null}}, address: {rule: network + index}}\n"
    (error,) = errors_of(tmp_path, text)
    assert (error.code, error.path) == ("INV036", "nodes.n[01-39].address")
    assert error.message == "the rule uses `network`, but the node is in no mesh (node 'n01')"
