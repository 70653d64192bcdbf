"""The help lists the commands in groups, in the order in which a new user needs them."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import pytest

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


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("words", ["--help", "run --help", "new --help"])
def test_help_is_that_of_typer_with_all_its_imports(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    code = f"import sys; sys.argv = {['egvs', *words.split()]}; from egvs.cli.app import main; main()"
    texts = []
    for imports in ("", "import typer.rich_utils; "):
        done = subprocess.run([sys.executable, "-c", imports + code], check=True, capture_output=True, text=True)
        texts.append(done.stdout)
    assert texts[0] == texts[1]
    assert "\x1b[" in texts[0]
