"""Which commands there are: those of the core by panel, and those of extensions, loaded when they are needed.

Commands of extensions are entry points of the group ``egvs.commands``, each a tuple of :class:`Command`. They are read
only for ``egvs --help`` and for a command that the core does not have, so that the core's commands start as quickly
with any number of extensions. A command of the core cannot be replaced.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import typer
from typer.core import TyperGroup

from egvs.core import plugins
from egvs.core.errors import MissingBackendError

GROUP = "egvs.commands"
"""The group of entry points."""

PANELS = {
    "Start here": ("new", "demo", "check", "run"),
    "Decide": ("place", "explore", "compare", "what-if"),
    "Study": ("accuracy", "effects"),
    "Stages of egvs run": ("traffic", "statics", "tpog", "scan", "score", "report"),
    "Files": ("runs", "export", "figure", "sensors", "verify", "store"),
}
"""Panels of ``egvs --help``, and the commands of the core in them."""

MODULES = {"compare": "egvs.cli.compare", "place": "egvs.cli.place", "what-if": "egvs.cli.what_if"}
"""Commands of the core in modules of their own, which have the function of that name."""

SHIPPED = {
    "city": ("city",),
    "desk": ("desk",),
    "hardware": ("accept", "sensor", "sheets"),
    "validation": ("clouds", "scores", "train", "validate"),
}
"""Extensions that come with this program, and their commands: for messages where one was taken away."""


class Command(NamedTuple):
    """A command of an extension.

    Attributes
    ----------
    name
        What users type after ``egvs``.
    panel
        Panel of ``egvs --help`` that lists it; a panel that the core lacks comes before its last one.
    app
        A function as for ``typer.Typer.command``, or a Typer app with commands of its own.
    """

    name: str
    panel: str
    app: typer.Typer | Callable[..., None]


class ExtensibleGroup(TyperGroup):
    """The commands of the core, and those of extensions once they are needed."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command of the core, else of an extension; None if there is no such command."""
        if cmd_name in MODULES:
            self._add(core_command(cmd_name))
        elif cmd_name not in self.commands:
            for name in MODULES:  # for suggestions
                self._add(core_command(name))
            for extension in plugins.plugin_names(GROUP):
                self._add(extension_commands(extension))
        return super().get_command(ctx, cmd_name)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, by panel; an extension that cannot be loaded is reported and left out."""
        for name in MODULES:
            self._add(core_command(name))
        for extension in plugins.plugin_names(GROUP):
            try:
                self._add(extension_commands(extension))
            except MissingBackendError as error:
                print(error, file=sys.stderr)
        commands: dict[str, Any] = dict(self.commands)  # Typer's own class of commands has no panel
        core = [name for names in PANELS.values() for name in names]
        for panel, names in PANELS.items():
            for name in names:
                commands[name].rich_help_panel = panel
        *first, last = PANELS
        new = [command.rich_help_panel for command in commands.values() if command.rich_help_panel not in PANELS]
        panels = list(dict.fromkeys([*first, *new, last]))
        ordered = [*core, *(name for name in commands if name not in core)]
        return sorted(ordered, key=lambda name: panels.index(commands[name].rich_help_panel))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the arguments name; an error names the extension that has it."""
        for extension, names in SHIPPED.items():
            if args[0] in names and self.get_command(ctx, args[0]) is None:
                ctx.fail(f"{args[0]!r} needs the extension {extension}, which is not installed.")
        return super().resolve_command(ctx, args)

    def _add(self, commands: dict[str, Any]) -> None:
        for name, command in commands.items():
            self.commands.setdefault(name, command)


@cache
def core_command(name: str) -> dict[str, Any]:
    """Load the command of the core in a module of :data:`MODULES`, by its name."""
    function = getattr(import_module(MODULES[name]), name.replace("-", "_"))
    return _typer_commands([Command(name, "", function)])


@cache
def extension_commands(extension: str) -> dict[str, Any]:
    """Load the commands of an extension, by name.

    Raises
    ------
    MissingBackendError
        When the entry point cannot be loaded, or is no tuple of :class:`Command`.
    """
    return _typer_commands(plugins.load_rows(GROUP, extension, Command))


def _typer_commands(declared: Iterable[Command]) -> dict[str, Any]:
    holder = typer.Typer(add_completion=False)
    for command in declared:
        if isinstance(command.app, typer.Typer):
            holder.add_typer(command.app, name=command.name, rich_help_panel=command.panel)
        else:
            holder.command(command.name, rich_help_panel=command.panel)(command.app)
    return dict(typer.main.get_group(holder).commands)
