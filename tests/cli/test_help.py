"""The help lists the commands in groups, in the order in which a new user needs them, and shows all that it says."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer
from rich.text import Text
from typer.core import TyperGroup

from egvs.cli.app import app
from egvs.cli.commands import PANELS


def test_help_starts_with_new_and_shows_groups_in_order(run_egvs: Any) -> None:
    code, printed, _ = run_egvs("--help")
    assert code == 0
    *first, last = PANELS
    titles = re.findall(r"╭─ ([\w ]+?) ─", printed)
    assert [title for title in titles if title in PANELS] == list(PANELS)
    assert (titles[: 1 + len(first)], titles[-1]) == (["Options", *first], last)
    commands = re.findall(r"^│ (\w[\w-]*)  ", printed, re.MULTILINE)
    core = [name for names in PANELS.values() for name in names]
    assert [name for name in commands if name in core] == core
    assert commands[0] == "new"


def helps(group: TyperGroup, context: Any) -> Iterator[tuple[str, str]]:
    """Yield the name of each command and parameter, and its help as it is written in the program."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield name, command.help or ""
        if isinstance(command, TyperGroup):
            yield from helps(command, context)
        yield from (
            (f"{name} {parameter.name}", getattr(parameter, "help", None) or "") for parameter in command.params
        )


def test_help_shows_names_in_brackets() -> None:
    program = typer.main.get_command(app)
    assert isinstance(program, TyperGroup)
    texts = dict(helps(program, program.make_context("egvs", [], resilient_parsing=True)))
    assert "\\[what_if.NAME]" in texts["what-if only"]
    swallowed = [name for name, text in texts.items() if Text.from_markup(text).spans]
    assert not swallowed, f"write \\[ for a bracket that the help shows: {swallowed}"
