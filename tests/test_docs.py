"""The pages for people: every file, command and option they name exists, and the generated ones are well formed."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from docgen.commands import Command, programs
from docgen.pages import man_pages, pages
from tests.plain_english import bad_page_words

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]

# facts that were copied from elsewhere and name files of other projects
FOREIGN = {"field-needs.md", "lab-facts.md", "legacy-wire.md", "openwrt-facts.md", "ros-facts.md", "transport-facts.md"}
PACKAGE_FILE = re.compile(
    r"(?<![\w/.-])(?:tests/|benchmarks/)?(?:meshctl|meshlab|udp_mesh|docgen)/[\w/.-]+\.(?:py|sh|init|awk)\b"
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_source_file_that_a_page_names_exists(page: Path) -> None:
    named = set(PACKAGE_FILE.findall(page.read_text(encoding="utf-8")))
    # tests mirror the packages, and some pages leave out `tests/`
    missing = {name for name in named if not (ROOT / name).is_file() and not (ROOT / "tests" / name).is_file()}
    assert missing == set() or page.name in FOREIGN


def test_every_claim_of_the_threat_model_names_existing_tests() -> None:
    text = (DOCS / "threat-model.md").read_text(encoding="utf-8")
    tests = ROOT / "tests" / "udp_mesh"
    files = set(re.findall(r"`((?:\w+/)+test_\w+\.py)`", text))
    assert len(files) > 15
    assert {name for name in files if not (tests / name).is_file()} == set()
    sources = "".join(path.read_text(encoding="utf-8") for path in tests.rglob("test_*.py"))
    functions = set(re.findall(r"`(test_\w+)", text))
    assert functions
    assert {name for name in functions if f"def {name}(" not in sources} == set()


def test_node_assumptions_reference_existing_files_and_identifiers() -> None:
    """The tables of node-assumptions.md name files relative to meshctl/ or to the scripts that run on a node."""
    text = (DOCS / "facts/node-assumptions.md").read_text(encoding="utf-8")
    rows = [row.split("|") for row in text.splitlines() if row.startswith("| ")]
    named = {name for row in rows if len(row) == 7 for name in re.findall(r"`((?:\w+/)*\w+\.(?:py|sh|init))`", row[2])}
    places = ("meshctl", "meshctl/device", "meshctl/device/scripts")
    assert len(named) > 15
    assert {name for name in named if not any((ROOT / place / name).is_file() for place in places)} == set()
    # `file.py` followed by names that look like code: they stand in that file
    sources = {name: (ROOT / place / name) for name in named for place in places if (ROOT / place / name).is_file()}
    wrong = {
        (name, word)
        for row in rows
        if len(row) == 7
        for name, words in re.findall(r"`([\w/]+\.(?:py|sh|init))`((?: \w+,?)*)", row[2])
        for word in re.findall(r"\w*_\w+", words)
        if word not in sources[name].read_text(encoding="utf-8")
    }
    assert wrong == set()


def table(page: Path, heading: str) -> dict[str, str]:
    """The first two columns of the table below a heading."""
    section = page.read_text(encoding="utf-8").split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    rows = [row.strip("| ").split(" | ") for row in section.splitlines() if row.startswith("| ")]
    return {row[0]: row[1] for row in rows[2:]}


def test_the_contributor_guide_says_where_things_are() -> None:
    places = table(ROOT / "CONTRIBUTING.md", "Where is ...")
    for subject in ("rolled back", "lost packet", "window", "offline", "priority", "quoted", "stale entry", "fault"):
        (place,) = [files for what, files in places.items() if subject in what]
        files = re.findall(r"`([^`]+)`", place)
        assert files, subject
        assert [name for name in files if not (ROOT / name).is_file()] == []


def test_the_layout_names_existing_directories() -> None:
    assert [name for name in table(ROOT / "CONTRIBUTING.md", "Layout") if not (ROOT / name.strip("`")).is_dir()] == []


@pytest.fixture(scope="module")
def commands() -> dict[str, Command]:
    return {command.name: command for program in programs() for command in program.walk()}


CODE = re.compile(r"^ *```(?:sh|console)?\n(.*?)^ *```|`((?:meshctl|udp-mesh) [^`]+)`", re.MULTILINE | re.DOTALL)


def command_lines(page: Path) -> Iterator[str]:
    """Calls of the two programs in code blocks and in backticks, without comments and what follows a pipe."""
    for block, inline in CODE.findall(page.read_text(encoding="utf-8")):
        for line in (inline or block).splitlines():
            for call in re.split(r"\s#\s|\|| && |;|>|<", line.strip().removeprefix("$ ")):
                if re.match(r"(meshctl|udp-mesh) [a-z]", call.strip()):
                    yield call.strip()


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "facts" not in page.parts], ids=lambda page: str(page.relative_to(ROOT))
)
def test_every_command_and_option_that_a_page_shows_exists(page: Path, commands: dict[str, Command]) -> None:
    wrong = []
    for line in command_lines(page):
        try:
            words = shlex.split(line)
        except ValueError:
            words = line.split()
        # behind `--` stands a command for the node
        own = words[: words.index("--")] if "--" in words else words
        name = own[0]
        for word in own[1:]:
            if f"{name} {word}" not in commands:
                break
            name += f" {word}"
        if name in ("meshctl", "udp-mesh"):
            # a word in prose such as "meshctl and udp-mesh"
            continue
        known = {each for option in commands[name].options for each in option.names} | {"--help", "-h"}
        options = {word.split("=")[0] for word in own if re.match(r"--?[a-z]", word)}
        wrong += [f"{line}: {option}" for option in sorted(options - known)]
    assert wrong == []


def test_the_tutorial_shows_the_output_of_every_command() -> None:
    text = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    lines = [line for block in re.findall(r"```console\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    silent = re.compile(r"\$ (export|sed -i) ")
    for line, following in zip(lines, [*lines[1:], "$ "], strict=True):
        assert silent.match(line) or not line.startswith("$ ") or not following.startswith("$ "), line


def test_every_picture_is_shown_and_made_by_a_script() -> None:
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    script = "".join((ROOT / "scripts" / name).read_text(encoding="utf-8") for name in ("pictures", "page-pictures"))
    # Those of the links are made, and compared with the list of links, by benchmarks/unfamiliar_links and its test.
    links = [f"links/{picture.stem}" for picture in (DOCS / "images/links").iterdir()]
    assert [name for name in links if not any(f"images/{name}.svg" in text for text in texts)] == []
    pictures = [picture.name for picture in (DOCS / "images").iterdir() if picture.is_file()]
    assert len(pictures) > 5
    assert [name for name in pictures if not any(f"images/{name}" in text for text in texts)] == []
    assert [name for name in pictures if f'"{name}"' not in script and f'"{Path(name).stem}"' not in script] == []


def test_the_site_lists_every_page() -> None:
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))

    def files(entry: object) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        elif isinstance(entry, list):
            for each in entry:
                yield from files(each)
        elif isinstance(entry, dict):
            yield from files(list(entry.values()))

    listed = set(files(site["nav"]))
    generated = {"index.md", "contributing.md", "changelog.md"} | {f"reference/{name}" for name in pages()}
    written = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}
    assert listed == {page for page in written | generated if not page.startswith("lint/MC")}


def test_the_reference_describes_every_command(commands: dict[str, Command]) -> None:
    made = pages()
    text = made["cli-meshctl.md"] + made["cli-udp-mesh.md"]
    for command in commands.values():
        if not command.commands:
            assert f"## `{command.name}`" in text
            assert command.summary, command.name
    assert "| `confirm_window_s` |" in made["inventory-keys.md"]
    assert "| `label` | string |" in made["inventory-keys.md"]
    assert "| `offline_s` | number | `10.0` |" in made["daemon-configuration.md"]
    assert "| `udp_mesh_peer_online` | gauge | `peer` |" in made["metrics.md"]


@pytest.mark.parametrize("name", ["meshctl.1", "udp-mesh.1"])
def test_man_pages_are_well_formed(name: str, tmp_path: Path, commands: dict[str, Command]) -> None:
    text = man_pages()[name]
    requests = [line.split()[0] for line in text.splitlines() if line.startswith(".")]
    assert set(requests) <= {".TH", ".nh", ".ad", ".SH", ".SS", ".B", ".PP", ".TP", ".nf", ".fi"}
    assert requests[0] == ".TH"
    sections = re.findall(r"^\.SH (.*)$", text, re.MULTILINE)
    assert sections[:3] == ["NAME", "SYNOPSIS", "DESCRIPTION"]
    shown = {
        command.usage for command in commands.values() if command.name.split()[0] == name[:-2] and not command.commands
    }
    headings = {heading.replace(r"\-", "-") for heading in re.findall(r"^\.SS (.*)$", text, re.MULTILINE)}
    assert shown <= headings
    if shutil.which("groff") is None:
        # the structure above is all that was checked
        return
    (tmp_path / name).write_text(text, encoding="utf-8")
    done = subprocess.run(["groff", "-man", "-ww", "-z", tmp_path / name], capture_output=True, text=True, check=True)
    assert done.stderr == ""


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.name not in FOREIGN], ids=lambda page: str(page.relative_to(ROOT))
)
def test_pages_use_plain_words(page: Path) -> None:
    assert bad_page_words(page.read_text(encoding="utf-8")) == []


def test_help_and_descriptions_of_keys_use_plain_words() -> None:
    bad = {name: bad_page_words(text) for name, text in pages().items()}
    assert {name: words for name, words in bad.items() if words} == {}
