"""The help lists the commands in groups, in the order in which a new user needs them."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import pytest

from egvs.cli.app import COMMAND_GROUPS


def test_help_starts_with_new_and_shows_groups_in_order(run_egvs: Any) -> None:
    code, printed, _ = run_egvs("--help")
    assert code == 0
    titles = re.findall(r"╭─ ([\w ]+?) ─", printed)
    assert titles == ["Options", *COMMAND_GROUPS]
    commands = re.findall(r"^│ (\w[\w-]*)  ", printed, re.MULTILINE)
    assert commands == [name for names in COMMAND_GROUPS.values() for name in names]
    assert commands[0] == "new"


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("words", ["--help", "run --help", "new --help", "city --help"])
def test_help_is_that_of_typer_with_all_its_imports(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    code = f"import sys; sys.argv = {['egvs', *words.split()]}; from egvs.cli.app import main; main()"
    texts = []
    for imports in ("", "import typer.rich_utils; "):
        done = subprocess.run([sys.executable, "-c", imports + code], check=True, capture_output=True, text=True)
        texts.append(done.stdout)
    assert texts[0] == texts[1]
    assert "\x1b[" in texts[0]
