"""`meshctl inventory import` and `export --format csv`: a table out, a table in, and every error at its line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from meshctl.cli.main import build, main
from meshctl.diagnostics import InvalidInput
from meshctl.inventory import edit, load_fleet
from meshctl.inventory.codes import MAX_DIAGNOSTICS
from meshctl.inventory.csv_table import edits, read, write
from meshctl.inventory.tree import MappingNode
from tests.meshctl.inventory.inventories import SHIPPED

EXAMPLE = SHIPPED / "subt-final"


@pytest.fixture
def inventory(tmp_path: Path) -> Path:
    return Path(shutil.copytree(EXAMPLE, tmp_path / "fleet"))


def run(inventory: Path, table: str, *options: str) -> Result:
    words = ["inventory", "import", "-", "-i", str(inventory), *options]
    return CliRunner().invoke(build("inventory"), words, input=table)


def errors_of(text: str) -> list[tuple[int, str]]:
    with pytest.raises(InvalidInput) as raised:
        edits(read(text, "boxes.csv"), load_fleet(EXAMPLE), "boxes.csv")
    return [(item.position.line, item.text) for item in raised.value.diagnostics]


def test_importing_an_unchanged_export_makes_no_edits() -> None:
    fleet = load_fleet(EXAMPLE)
    rows = read(write(fleet.nodes.values()), "boxes.csv")
    assert len(rows) == len(fleet.nodes)
    assert edits(rows, fleet, "boxes.csv") == ()


def test_an_export_does_not_overwrite_the_inventory(inventory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = inventory / "fleet.yaml"
    before = file.read_bytes()
    with pytest.raises(SystemExit) as ended:
        main(["inventory", "export", "--format", "csv", "-i", str(inventory), "--out", str(file)])
    assert ended.value.code == 2
    assert f"error: {file} is a file of the inventory, and would be overwritten" in capsys.readouterr().err
    assert file.read_bytes() == before


def test_values_are_set_and_comments_stay(inventory: Path) -> None:
    before = (inventory / "fleet.yaml").read_text(encoding="utf-8")
    done = run(inventory, "node,serial,mac\nhusky1-b01,SN-0017,02-00-5E-00-00-01\nbase,,02:00:5e:00:00:02\n")
    assert done.exit_code == 0, done.output
    fleet = load_fleet(inventory)
    assert (fleet.nodes["husky1-b01"].serial, fleet.nodes["husky1-b01"].mac) == ("SN-0017", "02:00:5e:00:00:01")
    assert (fleet.nodes["base"].serial, fleet.nodes["base"].mac) == ("", "02:00:5e:00:00:02")
    after = (inventory / "fleet.yaml").read_text(encoding="utf-8")
    assert [line for line in before.splitlines() if "#" in line] == [line for line in after.splitlines() if "#" in line]
    assert (fleet.nodes["husky1-b02"].serial, fleet.nodes["husky1-b02"].mac) == ("", "")


def test_a_row_without_a_name_is_found_by_its_label(inventory: Path) -> None:
    done = run(
        inventory,
        "\ufeffLabel;Serial number;Owner\r\nh1f;SN-1;lab\r\n",
        "--column",
        "serial=Serial number",
        "--ignore",
        "owner",
    )
    assert done.exit_code == 0, done.output
    node = load_fleet(inventory).nodes["husky1-front"]
    # the inventory writes it in capitals, the table does not
    assert (node.serial, node.label) == ("SN-1", "h1f")


def test_nodes_are_added_only_on_request(inventory: Path) -> None:
    table = "node\thardware\taddress\nextra1\tbeacon\t10.42.0.250\n"
    refused = run(inventory, table)
    assert refused.exit_code == 2
    assert "standard input:2: node: expected a node of the inventory, found 'extra1'" in refused.stderr
    assert "extra1" not in load_fleet(inventory).nodes
    assert run(inventory, table, "--add").exit_code == 0
    assert str(load_fleet(inventory).nodes["extra1"].address.ip) == "10.42.0.250"


def test_a_cell_lists_the_groups_of_a_node(inventory: Path) -> None:
    table = "node;hardware;address;groups\nextra1;;10.42.0.250; legged   beacons\nbase;;;beacons\n"
    done = run(inventory, table, "--add")
    assert done.exit_code == 0, done.output
    fleet = load_fleet(inventory)
    assert fleet.nodes["extra1"].groups == ("legged", "beacons")
    assert fleet.nodes["base"].groups == ("beacons",)
    assert not edits(read(write(fleet.nodes.values()), "boxes.csv"), fleet, "boxes.csv")


def test_an_unknown_group_in_a_table_is_not_written(inventory: Path) -> None:
    before = (inventory / "fleet.yaml").read_bytes()
    done = run(inventory, "node,groups\nhusky1-b01,beacons\nbase,beacon\n")
    assert done.exit_code == 2
    assert (
        "error: standard input:3: groups: unknown group 'beacon' [INV032]\n  = did you mean 'beacons'?" in done.stderr
    )
    assert (inventory / "fleet.yaml").read_bytes() == before


def test_an_invalid_new_node_is_not_written(inventory: Path) -> None:
    before = (inventory / "fleet.yaml").read_bytes()
    done = run(inventory, "node,label\nextra1,X1\n", "--add")
    assert done.exit_code == 2
    assert "nothing was written" in done.stderr
    assert "the node has no hardware" in done.stderr
    assert (inventory / "fleet.yaml").read_bytes() == before


def test_a_dry_run_shows_the_change_and_writes_nothing(inventory: Path) -> None:
    before = (inventory / "fleet.yaml").read_bytes()
    done = run(inventory, "node,serial\nbase,SN-1\n", "--dry-run")
    assert "serial: SN-1" in done.stdout
    assert "1 row: 1 node to change, 0 to add" in done.stderr
    assert (inventory / "fleet.yaml").read_bytes() == before


def test_json_lists_what_is_set_on_each_node(inventory: Path) -> None:
    done = run(inventory, "node,serial\nbase,SN-1\nhusky1-b01,\n", "--json", "--dry-run")
    assert json.loads(done.stdout)["nodes"] == [{"node": "base", "line": 2, "new": False, "values": {"serial": "SN-1"}}]


def test_all_wrong_values_are_reported_at_their_lines() -> None:
    found = errors_of(
        "node,mac,state,address\n"
        "base,02:00:5e:00:00:01,,\n"
        '"husky1-b01",02:00:5e:00:00:01,deploid,10.42.0\n'
        "husky1-b01,nonsense,,\n"
        "base2 x,,,,beyond\n"
    )
    assert [line for line, _ in found] == [3, 3, 3, 4, 4, 5]
    assert "address: expected" in "\n".join(text for _, text in found)
    assert (3, "mac: expected a value of one device, found '02:00:5e:00:00:01', which line 2 has too") in found
    assert (4, "node: expected a value of one device, found 'husky1-b01', which line 3 has too") in found
    assert (5, "expected 4 cells, as in the header, found 'beyond' beyond") in found


@pytest.mark.parametrize(
    ("table", "line", "text"),
    [
        ("", 1, "expected a header with a column 'node' or 'label', found none"),
        ("serial,mac\nSN-1,\n", 1, "expected a header with a column 'node' or 'label', found 'serial', 'mac'"),
        ("Our boxes,\nnode,serial\n", 1, "expected a header with a column 'node' or 'label', found 'Our boxes'"),
        ("node,seral\nbase,1\n", 1, "expected a column of node, label, serial"),
        ("node,serial,Serial\nbase,1,2\n", 1, "serial: expected one column, found two"),
        ('node,serial\n"base,1\n', 2, "expected CSV, found a quotation mark without its end"),
        ('sep=;\nnode;serial\n"base;1\n', 3, "expected CSV, found a quotation mark without its end"),
        ("node,mac\nbase,02:00:5E:00:00\n", 2, "found '02:00:5E:00:00'"),
        (
            'node,serial\nbase,"=""0012"""\n',
            2,
            """serial: expected the text that is on the device, found '="0012"', a""",
        ),
        ("node,mac\nbase,#N/A\n", 2, "mac: expected the text that is on the device, found '#N/A', a formula or its"),
        ("node,serial\nbase,1.23E+11\n", 2, "found '1.23E+11', a number that a spreadsheet shortened"),
        ("node,serial\nbase,SN\u200b1\n", 2, "with the invisible character U+200B"),
        ('node,label\n\n"base\n",\nbose,\n', 5, "node: expected a node of the inventory, found 'bose'"),
        ("node,label,serial\n,,SN-1\n", 2, "node: expected a name or a label, found neither"),
        ("label\nZZ\n", 2, "label: expected a node of the inventory, found 'ZZ'"),
    ],
)
def test_an_invalid_table_is_reported_with_its_line(table: str, line: int, text: str) -> None:
    ((at, found), *_) = errors_of(table)
    assert at == line
    assert text in found


def test_a_site_and_an_identifier_that_a_table_cannot_give_are_errors(inventory: Path) -> None:
    path = inventory / "fleet.yaml"
    text = path.read_text(encoding="utf-8") + "\nsites: {mine: {}, field: {}}\n"
    path.write_text(text, encoding="utf-8")
    assert run(inventory, "node,mac,serial\nbase,02:00:5e:00:00:01,S1\n").exit_code == 0
    rows = read("node,site,mac\nhusky1-b01,Mine,\nhusky1-b02,,02:00:5E:00:00:01\n", "boxes.csv")
    with pytest.raises(InvalidInput) as raised:
        edits(rows, load_fleet(inventory), "boxes.csv")
    site, mac = map(str, raised.value.diagnostics)
    assert raised.value.diagnostics[0].hint == "did you mean 'mine'?"
    assert "boxes.csv:2: site: expected a site of the inventory (mine, field), found 'Mine' [INV040]" in site
    assert "boxes.csv:3: mac: expected a value of one device, found '02:00:5e:00:00:01', which node base has" in mac
    # another device takes over the serial number, and base gets a new one
    swapped = run(inventory, "node,serial,site\nhusky1-b01,S1,mine\nbase,S2,\n")
    assert swapped.exit_code == 0, swapped.output
    assert load_fleet(inventory).nodes["husky1-b01"].serial == "S1"


def test_a_robot_a_hardware_and_an_address_that_a_table_cannot_give_are_errors(inventory: Path) -> None:
    before = load_fleet(inventory)
    taken = before.nodes["husky1-b01"].address.ip
    rows = read(
        f"node,robot,hardware,address,state\nbase,husky11,,,\nhusky1-b02,,Rocket,,\nhusky1-b03,,,{taken},\n",
        "boxes.csv",
    )
    with pytest.raises(InvalidInput) as raised:
        edits(rows, before, "boxes.csv")
    robot, hardware, address = map(str, raised.value.diagnostics)
    assert "boxes.csv:2: robot: expected a robot of the inventory (base-station, husky1, " in robot
    assert "found 'husky11' [INV040]" in robot
    assert raised.value.diagnostics[0].hint == "did you mean 'husky1'?"
    assert "boxes.csv:3: hardware: expected a hardware profile of the inventory (" in hardware
    assert (
        f"boxes.csv:4: address: expected an address of one node, found '{taken}', which node husky1-b01 has" in address
    )
    # two nodes swap addresses, or a lost one leaves its own to another
    other = before.nodes["husky1-b02"].address.ip
    assert edits(read(f"node,address\nhusky1-b01,{other}\nhusky1-b02,{taken}\n", "x"), before, "x")
    assert edits(read(f"node,address,state\nhusky1-b01,,lost\nhusky1-b02,{taken},\n", "x"), before, "x")
    both = read(f"node,address\nhusky1-b01,{other}\n", "x")
    with pytest.raises(InvalidInput, match="which node husky1-b02 has"):
        edits(both, before, "x")


@pytest.mark.parametrize(
    ("heading", "hint"),
    [
        ("MAC address", 'read it with --column "mac=MAC address", or skip it with --ignore "MAC address"'),
        ("Serial number", 'read it with --column "serial=Serial number"'),
        ("IP", 'read it with --column "address=IP"'),
    ],
)
def test_a_usual_heading_is_mapped_to_its_column(heading: str, hint: str) -> None:
    with pytest.raises(InvalidInput) as raised:
        read(f"node,{heading}\nbase,x\n", "boxes.csv")
    assert raised.value.diagnostics[0].hint.startswith(hint)


def test_an_address_with_its_prefix_length_is_no_change(inventory: Path) -> None:
    fleet = load_fleet(inventory)
    same = fleet.nodes["husky1-b01"].address
    assert edits(read(f"node,address\nhusky1-b01,{same}\n", "x"), fleet, "x") == ()
    assert edits(read(f"node,address\nhusky1-b01,{same.ip}/16\n", "x"), fleet, "x") != ()


def test_a_value_in_another_case_has_a_hint() -> None:
    with pytest.raises(InvalidInput) as raised:
        read("node,state\nbase,Deployed\n", "boxes.csv")
    assert raised.value.diagnostics[0].hint == "did you mean 'deployed'?"


def test_a_table_in_another_encoding_names_the_line(inventory: Path, tmp_path: Path) -> None:
    (tmp_path / "boxes.csv").write_bytes("node,label\nbase,B\nhusky1-b01,Käfer\n".encode("latin-1"))
    words = ["inventory", "import", str(tmp_path / "boxes.csv"), "-i", str(inventory)]
    done = CliRunner().invoke(build("inventory"), words)
    assert done.exit_code == 2
    assert "boxes.csv:3:13: the file is not UTF-8 text: found the byte 0xe4" in done.stderr


@pytest.mark.parametrize("option", ["serial", "serial=", "seral=Serial number"])
def test_a_wrong_column_option_is_an_error(inventory: Path, option: str) -> None:
    done = run(inventory, "node\nbase\n", "--column", option)
    assert done.exit_code == 2
    assert f"--column {option}" in done.stderr


def test_a_heading_that_resembles_a_column_may_be_skipped(inventory: Path) -> None:
    done = run(inventory, "node,Notes\nbase,x\n")
    assert "did you mean 'node'? If not, map it with --column COLUMN=HEADING, or skip it" in done.stderr


@pytest.mark.parametrize("written", ["02005E000001", "0200.5e00.0001", "02-00-5e-00-00-01"])
def test_mac_addresses_are_read_as_labels_barcodes_and_switches_write_them(inventory: Path, written: str) -> None:
    assert run(inventory, f"node,mac\nbase,{written}\n").exit_code == 0
    assert load_fleet(inventory).nodes["base"].mac == "02:00:5e:00:00:01"


def test_the_line_that_names_the_delimiter_is_no_header(inventory: Path) -> None:
    """Excel writes it, and shows the others as a table because of it."""
    assert run(inventory, "sep=;\r\nnode;serial\r\nbase;a,b,c\r\n").exit_code == 0
    assert load_fleet(inventory).nodes["base"].serial == "a,b,c"


@pytest.mark.parametrize("written", ["on", "0x10", "1e3", "00123", "~", "null", "1_000", "12:30:00", "NaN"])
def test_what_yaml_would_read_as_something_else_stays_text(inventory: Path, written: str) -> None:
    assert run(inventory, f"node,serial\nbase,{written}\n").exit_code == 0
    assert load_fleet(inventory).nodes["base"].serial == written


def test_the_errors_of_a_table_for_another_fleet_are_bounded() -> None:
    found = errors_of("node\n" + "".join(f"x{number}\n" for number in range(5000)))
    assert len(found) == MAX_DIAGNOSTICS


def test_the_text_is_parsed_for_each_column_and_not_for_each_row(
    inventory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before, 5,000 rows took more than ten minutes."""
    parsed: list[Path] = []

    def counting(file: Path, text: str) -> MappingNode | None:
        parsed.append(file)
        return compose(file, text)

    compose = edit._compose
    monkeypatch.setattr(edit, "_compose", counting)
    rows = "".join(f"x{number},beacon,10.42.7.{number},S{number}\n" for number in range(1, 201))
    done = run(inventory, f"node,hardware,address,serial\nbase,,,S0\nhusky1-b01,,,S201\n{rows}", "--add")
    assert done.exit_code == 0, done.output
    assert len(parsed) < 10
    nodes = load_fleet(inventory).nodes
    assert [nodes[f"x{number}"].serial for number in range(1, 201)] == [f"S{number}" for number in range(1, 201)]
    added = [name for name in nodes if name.startswith("x")]
    assert added == [f"x{number}" for number in range(1, 201)]
