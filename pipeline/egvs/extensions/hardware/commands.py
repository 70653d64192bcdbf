"""The commands of this extension: ``egvs sheets``, ``accept`` and ``sensor``."""

from __future__ import annotations

from egvs.cli.commands import Command
from egvs.extensions.hardware import installation_commands, sensor_commands

COMMANDS = (
    Command("sheets", "Install", installation_commands.sheets),
    Command("accept", "Install", installation_commands.accept),
    Command("sensor", "Files", sensor_commands.app),
)
