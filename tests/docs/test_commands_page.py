"""The table of docs/commands.md has every command of the program, each with a how-to that shows it."""

from __future__ import annotations

import csv
import re

import typer
from typer.core import TyperGroup

from egvs.cli.app import app
from tests.docs.pages import DOCS, links, section

PAGE = DOCS / "commands.md"


def table_rows() -> list[tuple[str, str]]:
    """Return the name and the how-to of each command of the table."""
    with (DOCS / "data" / "commands.csv").open(encoding="utf-8", newline="") as file:
        return [(row["command"].strip("`").removeprefix("egvs "), row["how to"]) for row in csv.DictReader(file)]


def program_commands() -> list[str]:
    """Return all commands, those of a group with the name of the group, in the order of the help."""
    program = typer.main.get_command(app)
    assert isinstance(program, TyperGroup)
    context = program.make_context("egvs", [], resilient_parsing=True)
    names = []
    for name in program.list_commands(context):
        command = program.get_command(context, name)
        if isinstance(command, TyperGroup):
            names += [f"{name} {part}" for part in command.commands]
        else:
            names.append(name)
    return names


def test_page_lists_every_command_in_the_order_of_the_help() -> None:
    assert [name for name, _ in table_rows()] == program_commands()


def test_how_to_shows_the_command() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name, how_to in table_rows():
        targets = list(links(how_to))
        assert targets, name
        page, _, anchor = targets[0].partition("#")
        how_to_text = (DOCS / page).read_text(encoding="utf-8") if page else text
        if anchor:
            how_to_text = section(how_to_text, anchor)
        assert re.search(rf"egvs {name}\b", how_to_text), f"{targets[0]} does not mention egvs {name}"
