"""The help lists the commands in groups, in the order in which a new user needs them."""

from __future__ import annotations

import re
from typing import Any

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
