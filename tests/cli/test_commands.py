"""Commands of extensions: found by entry points, listed in the help, and never in place of the core's."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from egvs.cli import commands
from egvs.core import plugins
from egvs.core.errors import MissingBackendError
from tests.core.test_plugins import clear_caches, install

MODULE = """
import typer
from egvs.cli.commands import Command

def greet(name: str) -> None:
    \"\"\"Greet somebody.\"\"\"
    print("hello", name)

def run() -> None:
    \"\"\"Nobody should come here.\"\"\"
    raise SystemExit(9)

group = typer.Typer(help="Two verbs.", no_args_is_help=True)
group.command()(greet)
group.command("wave")(lambda: print("waves"))

COMMANDS = (Command("greet", "Greetings", greet), Command("run", "Decide", run), Command("group", "Decide", group))
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path in which extensions are installed."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(tmp_path))
    clear_caches()
    commands.extension_commands.cache_clear()
    yield tmp_path
    clear_caches()
    commands.extension_commands.cache_clear()
    for name in set(sys.modules) - before:
        if name.startswith("plug_"):
            del sys.modules[name]


@pytest.mark.slow
def test_command_of_extension_runs_and_is_listed_in_its_panel(site: Path, run_egvs: Any) -> None:
    install(site, "greetings", "greetings = plug_greet:COMMANDS", {"plug_greet": MODULE}, commands.GROUP)
    assert run_egvs("greet", "you")[:2] == (0, "hello you\n")
    assert run_egvs("group", "wave")[:2] == (0, "waves\n")
    _, printed, _ = run_egvs("--help")
    titles = re.findall(r"╭─ ([\w ]+?) ─", printed)
    assert titles.index("Stages of egvs run") < titles.index("Greetings") < titles.index("Files")
    assert re.search(r"^│ greet +Greet somebody\.", printed, re.MULTILINE)
    assert "Nobody should come here" not in printed


def test_command_of_core_cannot_be_replaced(site: Path, run_egvs: Any) -> None:
    install(site, "greetings", "greetings = plug_greet:COMMANDS", {"plug_greet": MODULE}, commands.GROUP)
    code, _, error = run_egvs("run", site / "nowhere")
    assert code == 2 and "nowhere" in error


def test_commands_of_core_import_no_extension(site: Path, run_egvs: Any) -> None:
    install(site, "broken", "broken = plug_broken", {"plug_broken": "raise RuntimeError"}, commands.GROUP)
    assert run_egvs("sensors")[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "problem"),
    [("COMMANDS = 1 / 0", "its import raised ZeroDivisionError"), ("COMMANDS = ['greet']", "expected a tuple of egvs")],
)
def test_broken_extension_is_named_and_help_shows_the_others(
    site: Path, run_egvs: Any, source: str, problem: str
) -> None:
    install(site, "broken", "broken = plug_broken_commands:COMMANDS", {"plug_broken_commands": source}, commands.GROUP)
    code, _, error = run_egvs("gret")
    assert code == MissingBackendError.exit_code and problem in error and "of the package broken" in error
    code, printed, error = run_egvs("--help")
    assert code == 0 and "what-if" in printed
    assert problem in error and "of the package broken" in error


@pytest.mark.parametrize(("command", "extension"), [("city", "city"), ("sheets", "hardware"), ("train", "validation")])
def test_command_of_missing_extension_names_it(
    command: str, extension: str, run_egvs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "plugin_names", lambda group: [])
    monkeypatch.setenv("COLUMNS", "150")
    code, _, error = run_egvs(command, "folder")
    assert code == 2
    assert f"'{command}' needs the extension {extension}, which is not installed." in error


def test_comparison_of_traffic_needs_the_extension(
    tmp_path: Path, run_egvs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "plugin_names", lambda group: [])
    code, _, error = run_egvs("compare", tmp_path, tmp_path, "--tpog", tmp_path / "page.html")
    assert code == 2
    assert "--tpog: needs the extension tracks" in error
    assert not (tmp_path / "page.html").exists()


def test_table_of_shipped_commands_is_complete() -> None:
    for extension in plugins.plugin_names(commands.GROUP):
        assert sorted(commands.extension_commands(extension)) == sorted(commands.SHIPPED[extension])


def test_check_names_sensors_that_hang_upside_down(mini: Path, run_egvs: Any) -> None:
    assert "upside down" not in run_egvs("check", mini)[1]
    code, printed, error = run_egvs("check", mini, "--set", "sensors.small.mount=inverted")
    assert code == 0, error
    sites = len((mini / "sites.csv").read_text().splitlines()) - 1
    assert f"small hangs upside down at {sites} of {sites} sites" in printed
