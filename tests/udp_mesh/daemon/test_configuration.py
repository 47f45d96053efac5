"""The configuration: its values, and that every mistake is reported with its line."""

import base64
import dataclasses
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from udp_mesh.core.settings import Limits, Neighbour, Outbox, Rates, Topic
from udp_mesh.crypto import Key
from udp_mesh.daemon.configuration import (
    RESERVED_TOPICS,
    Configuration,
    DaemonSettings,
    load,
    read_keys,
)
from udp_mesh.daemon.neighbours import parse_address
from udp_mesh.daemon.toml_source import ConfigurationError, locate
from udp_mesh.daemon.topic_settings import topic_from_values
from udp_mesh.links.attachments import EVERY_INTERFACE, LinkConfig

FULL = """\
name = "ugv1"
port = 8701
key_file = "fleet.key"
window = 3
fragment_bytes = 1200

[topics]
status = { priority = 0, keep_last = 1 }
"map/diff" = { priority = 7, outbox = "all", outbox_on_disk = true, compression = true }

[topics.video]
priority = 9
reliable = false
deadline_s = 0.5
rate_limit_bytes_per_s = 250_000
destinations = [
  "base",  # where people look
]

[undeclared]
priority = 10

[[links]]
interface = "wlan*"

[[links]]
address = "127.0.0.2"
kind = "neighbors"
mtu = 1400

[[neighbors]]
name = "base"
address = "127.0.0.3"

[[neighbors]]
name = "old"
address = "127.0.0.4:8700"
legacy = true
link = "127.0.0.2"

[rates]
offline_s = 5

[limits]
message_bytes = 1_000_000

[daemon]
socket = "/run/mesh.sock"
socket_mode = "0666"
metrics_address = "127.0.0.1:9871"
"""

KEY = Key(bytes(range(32)))


def write(folder: Path, text: str, keys: str = KEY.secret.hex()) -> Path:
    (folder / "fleet.key").write_text(keys + "\n")
    path = folder / "udp-mesh.toml"
    path.write_text(text)
    return path


def problems(folder: Path, text: str) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        load(write(folder, text))
    return [str(problem).removeprefix(str(folder) + "/") for problem in caught.value.problems]


def test_every_setting_in_the_file_is_loaded(tmp_path: Path) -> None:
    configuration = load(write(tmp_path, FULL))
    settings = configuration.settings
    assert (settings.name, settings.port, settings.window, settings.fragment_bytes) == ("ugv1", 8701, 3, 1200)
    assert settings.keys == (KEY,)
    assert settings.topics == (
        Topic("status", priority=0, keep_last=1),
        Topic("map/diff", priority=7, outbox=Outbox.ALL, outbox_on_disk=True, compression=True),
        Topic(
            "video",
            priority=9,
            reliable=False,
            deadline_s=0.5,
            rate_limit_bytes_per_s=250_000,
            destinations=("base",),
        ),
        *RESERVED_TOPICS,
    )
    assert settings.undeclared is not None
    assert settings.undeclared.priority == 10
    assert settings.neighbours == (
        Neighbour(("127.0.0.3", 8701), "base"),
        Neighbour(("127.0.0.4", 8700), "old", "127.0.0.2", legacy=True),
    )
    assert settings.rates.offline_s == 5.0
    assert settings.limits.message_bytes == 1_000_000
    assert configuration.links == (LinkConfig("wlan*"), LinkConfig(None, "127.0.0.2", broadcast=False, mtu=1400))
    assert configuration.daemon.socket_mode == 0o666
    assert configuration.daemon.metrics_address == ("127.0.0.1", 9871)


def test_the_earlier_spelling_of_neighbors_is_accepted_beside_the_present_one(tmp_path: Path) -> None:
    """Files that an earlier meshctl deployed have it."""
    text = """\
key_file = "fleet.key"
[[links]]
address = "127.0.0.2"
kind = "neighbours"
[[neighbours]]
address = "127.0.0.3"
"""
    configuration = load(write(tmp_path, text))
    assert configuration == load(write(tmp_path, text.replace("neighbours", "neighbors")))
    assert configuration.links == (LinkConfig(None, "127.0.0.2", broadcast=False),)
    both = text + '[[neighbors]]\naddress = "127.0.0.3"\n'
    assert problems(tmp_path, both) == [
        'udp-mesh.toml:8: neighbors.0.address: expected each neighbor once, found "127.0.0.3"'
    ]


def test_key_file_is_the_only_required_setting(tmp_path: Path) -> None:
    configuration = load(write(tmp_path, 'key_file = "fleet.key"\n'))
    assert isinstance(configuration, Configuration)
    assert configuration.links == EVERY_INTERFACE
    assert configuration.settings.name


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            'name = "a b"',
            'udp-mesh.toml:2: name: expected a name of 1 to 63 bytes without spaces or slashes, found "a b"',
        ),
        ("name = 5", "udp-mesh.toml:2: name: expected a string, found 5"),
        (
            "[position]\nx_m = 1\ny_m = 2\nheading = 3",
            "udp-mesh.toml:5: position.heading: expected a known key, found heading = 3 "
            "(known keys: frame, x_m, y_m, z_m)",
        ),
        ("\nprot = 8700", "udp-mesh.toml:3: prot: expected a known key, found prot = 8700 (did you mean 'port'?)"),
        (
            '[topics]\nvideo = {}\nsocket = "/run/mesh.sock"',
            'udp-mesh.toml:4: topics.socket: expected a table, found "/run/mesh.sock" (it belongs in [daemon])',
        ),
        (
            '[daemon]\nrelay_key_file = "relay.key"',
            'udp-mesh.toml:3: daemon.relay_key_file: expected a known key, found relay_key_file = "relay.key" '
            "(it belongs above the first [table])",
        ),
        (
            '[topics]\na = {}\n[[links]]\naddress = "127.0.0.1"\npriority = 3',
            "udp-mesh.toml:6: links.0.priority: expected a known key, found priority = 3 "
            "(it belongs in the table of a topic)",
        ),
        ("port = 70000", "udp-mesh.toml:2: port: expected an integer from 1 to 65535, found 70000"),
        ("port = true", "udp-mesh.toml:2: port: expected an integer from 1 to 65535, found true"),
        ("window = 0", 'udp-mesh.toml:2: window: expected "adaptive" or an integer from 1 to 4096, found 0'),
        (
            "[topics]\na = {}\nvideo = { prioriti = 3 }",
            "udp-mesh.toml:4: topics.video.prioriti: expected a known key, found prioriti = 3 "
            "(did you mean 'priority'?)",
        ),
        (
            "[topics.video]\n\npriority = 16",
            "udp-mesh.toml:4: topics.video.priority: expected an integer from 0 to 15, found 16",
        ),
        ("[topics]\nvideo = 3", "udp-mesh.toml:3: topics.video: expected a table, found 3"),
        (
            '[topics]\nmap = { outbox = "lst" }',
            'udp-mesh.toml:3: topics.map.outbox: expected "none" or "last" or "all", found "lst" '
            "(did you mean 'last'?)",
        ),
        (
            "[topics]\nmap = { outbox_on_disk = true }",
            'udp-mesh.toml:3: topics.map.outbox_on_disk: expected outbox = "last" or "all" as well, found true',
        ),
        (
            "[topics]\nmap = { delta = 1 }",
            "udp-mesh.toml:3: topics.map.delta: expected true or false, found 1",
        ),
        (
            "[topics.map]\ndelta = true\ndelta_bytes = 0",
            "udp-mesh.toml:4: topics.map.delta_bytes: expected an integer from 1 to 1073741824, found 0",
        ),
        (
            "[topics.map]\nlog = {}\ndelta = true",
            "udp-mesh.toml:2: topics.map: expected no delta for a log, found true",
        ),
        (
            '[[neighbors]]\naddress = "fe80::1"',
            'udp-mesh.toml:3: neighbors.0.address: expected link = "INTERFACE" with a link-local address, '
            'found "fe80::1"',
        ),
        (
            '[[neighbors]]\naddress = "fd00::1"\nlegacy = true\nname = "old"',
            "udp-mesh.toml:3: neighbors.0.address: expected an IPv4 address (the legacy format has no IPv6), "
            'found "fd00::1"',
        ),
        (
            '[[links]]\naddress = "fe80::1"',
            "udp-mesh.toml:3: links.0.address: expected an address that is not link-local (set `interface` instead), "
            'found "fe80::1"',
        ),
        (
            "[limits]\nmessage_bytes = 99999999999",
            "udp-mesh.toml:3: limits.message_bytes: expected an integer from 1 to 1073741824, found 99999999999",
        ),
        ("[[links]]\nmtu = 1500", "udp-mesh.toml:2: links.0: expected either interface or address, found neither"),
        (
            '[[links]]\ninterface = "a"\n[[links]]\naddress = "10.0.0"',
            'udp-mesh.toml:5: links.1.address: expected an IPv4 or IPv6 address, found "10.0.0"',
        ),
        ('[[neighbors]]\nname = "b"', "udp-mesh.toml:2: neighbors.0: expected an address, found none"),
        ("[rates]\noffline_s = -1", "udp-mesh.toml:3: rates.offline_s: expected a number from 0 to 86400, found -1"),
        (
            '[daemon]\nsocket_mode = "rw"',
            'udp-mesh.toml:3: daemon.socket_mode: expected octal permissions in quotes such as "0660", found "rw"',
        ),
        (
            '[daemon]\nmetrics_address = "10.0.0.1:9"',
            "udp-mesh.toml:3: daemon.metrics_address: expected a loopback address with a port (127.0.0.1:9871), "
            'found "10.0.0.1:9"',
        ),
        (
            "name = ",
            "udp-mesh.toml:2: expected a value (text in quotes, a number, true, false, [...] or {...}), "
            "found something else (at column 8)",
        ),
        (
            "[topics\nx",
            "udp-mesh.toml:2: expected ']' at the end of a table declaration, found something else (at column 8)",
        ),
        (
            'name = "a"\nname = "b"',
            "udp-mesh.toml:3: expected each key once, found a duplicate key (at column 11)",
        ),
        ('name = """a', "udp-mesh.toml:3: expected TOML, found unterminated string (at the end of the file)"),
        (
            '\n[[link]]\ninterface = "eth0"',
            "udp-mesh.toml:3: link: expected a known key, found link = a list of tables (did you mean 'links'?)",
        ),
        (
            "[daemon]\nsocket_mode = 660",
            'udp-mesh.toml:3: daemon.socket_mode: expected octal permissions in quotes such as "0660", found 660',
        ),
        (
            '[daemon]\nmetrics_address = "127.0.0.1:²"',
            "udp-mesh.toml:3: daemon.metrics_address: expected a loopback address with a port (127.0.0.1:9871), "
            'found "127.0.0.1:²"',
        ),
        (
            '[daemon]\nuser = "a\\u0000"',
            'udp-mesh.toml:3: daemon.user: expected a string without NUL characters, found "a\\u0000"',
        ),
        (
            f'[daemon]\nsocket = "/{"s" * 200}"',
            f'udp-mesh.toml:3: daemon.socket: expected a path of at most 107 bytes (unix(7)), found "/{"s" * 56}..."',
        ),
        (
            '[topics]\nmap = { destinations = ["base", "a b"] }',
            "udp-mesh.toml:3: topics.map.destinations: expected node names, each a name of 1 to 63 bytes without "
            'spaces or slashes, found "a b"',
        ),
        (
            '[[neighbors]]\naddress = "10.0.0.1"\nname = "a/b"',
            "udp-mesh.toml:4: neighbors.0.name: expected a name of 1 to 63 bytes without spaces or slashes, "
            'found "a/b"',
        ),
        (
            '[[neighbors]]\naddress = "10.0.0.1"\n[[neighbors]]\naddress = "10.0.0.1:8700"',
            'udp-mesh.toml:5: neighbors.1.address: expected each neighbor once, found "10.0.0.1"',
        ),
        ('[daemon]\nsocket = ""', 'udp-mesh.toml:3: daemon.socket: expected a path, found ""'),
        ('[daemon]\nstate_directory = ""', 'udp-mesh.toml:3: daemon.state_directory: expected a path, found ""'),
        (
            "[topics.map]\npriority = 1\n[topics.map]\npriority = 2",
            "udp-mesh.toml:4: expected each table once, found a duplicate table [topics.map] (at column 12)",
        ),
        ("unkeyed = true", "udp-mesh.toml:2: unkeyed: expected either key_file or unkeyed, found both"),
    ],
)
def test_a_mistake_is_reported_with_file_line_expected_and_found_value(
    tmp_path: Path, text: str, expected: str
) -> None:
    assert problems(tmp_path, f'key_file = "fleet.key"\n{text}\n') == [expected]


def test_all_mistakes_are_reported_at_once(tmp_path: Path) -> None:
    found = problems(tmp_path, 'key_file = "fleet.key"\nport = 0\n[topics]\na = { priority = 99 }\nb = { x = 1 }\n')
    assert [problem.split(":")[1] for problem in found] == ["2", "4", "5"]


def test_a_missing_key_error_suggests_the_unkeyed_option(tmp_path: Path) -> None:
    assert problems(tmp_path, 'name = "a"\n') == [
        "udp-mesh.toml:1: key_file: expected a file with the fleet's key, found none "
        "(set unkeyed = true to run without protection)"
    ]


@pytest.mark.parametrize("key", [KEY.secret.hex(), KEY.secret.hex()[:-3], base64.b64encode(KEY.secret).decode()])
@pytest.mark.parametrize(
    "line", ["key = '{}'", "keys = ['{}', '{}']", "key_file = '{}'", "name = '{} # id'", "[topics]\nkey = '{}'"]
)
def test_a_key_in_a_wrong_place_is_not_shown(tmp_path: Path, line: str, key: str) -> None:
    found = "\n".join(problems(tmp_path, line.format(key, key)))
    assert "udp-mesh.toml" in found
    assert not any(key[start : start + 8] in found for start in range(len(key) - 8))


def test_a_missing_key_file_is_reported_at_the_line_that_references_it(tmp_path: Path) -> None:
    (problem,) = problems(tmp_path, 'name = "a"\nkey_file = "other.key"\n')
    assert problem.startswith("udp-mesh.toml:2: key_file: expected a readable file, found ")
    assert problem.endswith("other.key: No such file or directory")


def test_an_invalid_key_is_reported_by_line_and_never_shown(tmp_path: Path) -> None:
    path = tmp_path / "fleet.key"
    path.write_text(f"# the fleet's keys\n{KEY.secret.hex()}\nsecretsecret\n")
    with pytest.raises(ConfigurationError) as caught:
        read_keys(path)
    assert f"{path}:3: expected a key of 32 bytes" in str(caught.value)
    assert "secretsecret" not in str(caught.value)


@pytest.mark.parametrize("count", [0, 3])
def test_a_key_file_holds_one_or_two_keys(tmp_path: Path, count: int) -> None:
    path = tmp_path / "fleet.key"
    path.write_text(f"{KEY.secret.hex()}\n" * count)
    with pytest.raises(ConfigurationError, match=f"expected one or two keys, one per line, found {count}"):
        read_keys(path)


def test_an_unreadable_configuration_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"missing\.toml: expected a readable file"):
        load(tmp_path / "missing.toml")
    with pytest.raises(ConfigurationError, match=r"^[^:]*: expected a readable file, found Is a directory$"):
        load(tmp_path)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b'name = "a"\n\xff')
    with pytest.raises(ConfigurationError, match=r"binary.toml:2: expected UTF-8"):
        load(binary)


def test_a_command_changes_only_the_fields_it_names() -> None:
    before = Topic("map", priority=7, outbox=Outbox.ALL, destinations=("base",), deadline_s=60.0)
    after = topic_from_values("map", {"priority": 5}, before)
    assert after == Topic("map", priority=5, outbox=Outbox.ALL, destinations=("base",), deadline_s=60.0)
    with pytest.raises(ConfigurationError, match="did you mean 'deadline_s'"):
        topic_from_values("map", {"deadline": 5}, before)


@pytest.mark.parametrize("name", ["", "a b", "~mesh/ping", "x" * 256])
def test_an_invalid_topic_name_is_rejected(name: str) -> None:
    with pytest.raises(ConfigurationError):
        topic_from_values(name, {}, None)


def test_keys_are_located_by_line_despite_strings_comments_and_brackets() -> None:
    text = "\n".join(
        [
            'a = """',
            "b = 1",
            '"""',
            "c = [  # d = 1",
            "  1,",
            "]",
            "[x]",
            '"y.z" = { w = 1 }',
            "[[t]]",
            "k = 1",
            "[[t]]",
            "k = 2",
            "[t.inner]",
            "m.n = 3",
        ]
    )
    assert locate(text) == {
        ("a",): 1,
        ("c",): 4,
        ("x",): 7,
        ("x", "y.z"): 8,
        ("t",): 9,
        ("t", 0): 9,
        ("t", 0, "k"): 10,
        ("t", 1): 11,
        ("t", 1, "k"): 12,
        ("t", 1, "inner"): 13,
        ("t", 1, "inner", "m"): 14,
        ("t", 1, "inner", "m", "n"): 14,
    }


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("10.0.0.2", ("10.0.0.2", 8700)),
        ("10.0.0.2:9", ("10.0.0.2", 9)),
        ("fd00::2", ("fd00::2", 8700)),
        ("[fd00::2]:9", ("fd00::2", 9)),
        ("base", None),
        ("10.0.0.2:x", None),
        ("10.0.0.2:0", None),
    ],
)
def test_addresses_are_numeric_with_an_optional_port(text: str, address: tuple[str, int] | None) -> None:
    assert parse_address(text, 8700) == address


NUMBERS = ["0", "-1", "3", "1.5", "1e400", "nan", "inf", "99999999999999999999999", "07:32:00", "1979-05-27", "true"]
TABLES = ["[]", "[1]", "[{}]", "{}", "{ a = 1 }"]
TEXTS = [
    "",
    "x",
    "a b",
    "\\u0000",
    "²",
    "10.0.0.1:²",
    "127.0.0.1:0",
    "fe80::1%a",
    "all",
    "0777",
    "adaptive",
    "fleet.key",
    ".",
]
WORDS = [*NUMBERS, *TABLES, *(f'"{text}"' for text in TEXTS)]
KEYS = {
    "": ["name", "port", "window", "fragment_bytes", "topics", "links", "neighbors", "rates", "limits", "daemon", "x"],
    "[topics.x]": [item.name for item in dataclasses.fields(Topic)],
    "[undeclared]": [item.name for item in dataclasses.fields(Topic)],
    "[rates]": [item.name for item in dataclasses.fields(Rates)],
    "[limits]": [item.name for item in dataclasses.fields(Limits)],
    "[daemon]": [item.name for item in dataclasses.fields(DaemonSettings)],
    "[[links]]": ["interface", "address", "kind", "mtu"],
    "[[neighbors]]": ["address", "name", "link", "legacy"],
}


@settings(max_examples=60)
@given(data=st.data())
def test_any_value_in_the_file_is_accepted_or_reported(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    lines = ['key_file = "fleet.key"']
    for table in ["", *data.draw(st.lists(st.sampled_from([*KEYS][1:]), max_size=3, unique=True))]:
        lines.append(table)
        keys = data.draw(st.lists(st.sampled_from(KEYS[table]), max_size=3, unique=True))
        lines += [f"{key} = {data.draw(st.sampled_from(WORDS))}" for key in keys]
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_text("\n".join(lines))
    (path.parent / "fleet.key").write_text(KEY.secret.hex())
    try:
        load(path)
    except ConfigurationError as error:
        assert all(str(problem).startswith(f"{path}:") for problem in error.problems)
