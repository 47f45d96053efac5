"""Commands start fast because each imports only what it needs. `benchmarks/start_up.py` measures how fast."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.start_up import imported_modules, packages

ROOT = Path(__file__).resolve().parents[3]
MAIN = "meshctl.cli.main"
# every start of the program
ENTRANCE = frozenset(
    {
        "meshctl",
        "meshctl.cli",
        "meshctl.cli.command_group",
        "meshctl.cli.commands",
        "meshctl.cli.extensions",
        "meshctl.cli.main",
        "meshctl.cli.output",
        "meshctl.errors",
        "meshctl.report",
        "meshctl.report.terminal_escapes",
        "meshctl.start_up",
    }
)
# typer and what it imports, one of them only on some of its versions
TYPER = frozenset({"typer", "annotated_doc", "click", "shellingham", "typing_extensions"})


@pytest.mark.parametrize("words", [["--help"], ["--version"]], ids=" ".join)
def test_help_and_version_import_only_typer_and_the_command_table(words: list[str], tmp_path: Path) -> None:
    imported = imported_modules(MAIN, words, tmp_path)
    assert {name for name in imported if name.startswith(("meshctl", "meshlab"))} == ENTRANCE
    assert packages(imported) - {"meshctl"} <= TYPER
    # each takes milliseconds, and none is needed
    assert not imported & {"asyncio", "email", "importlib.metadata", "json", "sqlite3", "ssl"}


@pytest.mark.parametrize("command", ["provision", "status"])
def test_commands_over_ssh_import_neither_a_client_of_nats_nor_what_paramiko_takes_for_ssh_config(command: str) -> None:
    script = f"import sys; sys.argv = ['meshctl', '{command}', '--help']; from meshctl.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", script], capture_output=True, text=True, check=True
    )
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "paramiko.config" in imported
    assert not imported & {"invoke.context", "asyncio", "meshctl.sites.nats_uplink"}


def test_the_process_that_renders_templates_imports_no_loader_of_inventories() -> None:
    command = [sys.executable, "-X", "importtime", "-m", "meshctl.render.sandbox_worker", "1", str(1 << 30)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True)
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "jinja2" in imported
    assert not imported & {"pydantic", "yaml", "meshctl.inventory"}


def test_lint_of_shipped_templates_imports_no_ssh_no_cryptography_and_no_jinja(tmp_path: Path) -> None:
    imported = imported_modules(MAIN, ["lint", str(ROOT / "inventory" / "lab")], tmp_path)
    assert "meshctl.lint.check_path" in imported
    heavy = {"bcrypt", "cryptography", "jinja2", "meshlab", "nacl", "paramiko", "pyrage", "rich"}
    assert packages(imported).isdisjoint(heavy)
    assert not imported & {"asyncio", "sqlite3", "ssl", "xml"}
    assert not imported & {"meshctl.render.compare", "meshctl.report.findings.junit", "meshctl.report.findings.sarif"}


# Ctrl-C at this import: in the middle of the program's own, or of those of the command
_INTERRUPTED_AT = """
import builtins, os, signal, sys
real = builtins.__import__
def interrupted(name, *rest, **options):
    if name == {module!r}:
        os.kill(os.getpid(), signal.SIGINT)
    return real(name, *rest, **options)
signal.signal(signal.SIGINT, {handler})
from meshctl.__main__ import start
builtins.__import__ = interrupted
sys.argv[1:] = ["inventory", "list", "-i", {inventory!r}]
start()
"""


@pytest.mark.parametrize("module", ["typer", "meshctl.inventory"])
def test_ctrl_c_during_the_start_is_no_traceback(module: str) -> None:
    done = _start(module, "signal.default_int_handler")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_a_start_that_ignores_ctrl_c_continues() -> None:
    done = _start("typer", "signal.SIG_IGN")
    assert (done.returncode, done.stderr) == (0, "")
    assert "rover1-radio" in done.stdout


def _start(module: str, handler: str) -> subprocess.CompletedProcess[str]:
    inventory = str(ROOT / "inventory/starter")
    program = _INTERRUPTED_AT.format(module=module, handler=handler, inventory=inventory)
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
