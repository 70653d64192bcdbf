"""The help lists the commands in groups, in the order in which a new user needs them."""

from __future__ import annotations

import re
from typing import Any

from egvs.cli.app import COMMAND_GROUPS


def test_help_starts_with_new_and_shows_groups_in_order(run_egvs: Any) -> None:
    code, printed, _ = run_egvs("--help")
    assert code == 0
    titles = re.findall(r"╭─ ([\w ]+?) ─", printed)
    assert titles == ["Options", *COMMAND_GROUPS]
    commands = re.findall(r"^│ (\w[\w-]*)  ", printed, re.MULTILINE)
    assert commands == [name for names in COMMAND_GROUPS.values() for name in names]
    assert commands[0] == "new"
