"""Commands that are printed can be pasted into a shell, also where a name has spaces."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

import egvs
from egvs.cli import options, run_tables
from egvs.core.errors import InputError
from egvs.traffic import network

PACKAGE = Path(egvs.__file__).parent
QUOTED = {"run", "command", "name"}
"""Variables that hold quoted text, and names of commands."""


def unquoted_commands(text: str) -> list[str]:
    """Lines of source with a command in an f-string whose values are not quoted for a shell."""
    lines = []
    for line in text.splitlines():
        for command in re.findall(r"""f["'][^"']*?\begvs [a-z]+ ([^"']*)""", line):
            values = re.findall(r"\{([^}]*)\}?", command)
            if not all("shlex." in value or value in QUOTED for value in values):
                lines.append(line.strip())
    return lines


def test_no_value_in_a_command_is_unquoted() -> None:
    assert unquoted_commands('print(f"next: egvs run {folder} --count {shlex.quote(x)}")')
    found = {}
    for path in PACKAGE.rglob("*.py"):
        if lines := unquoted_commands(path.read_text(encoding="utf-8")):
            found[path.name] = lines
    no_command = ['source=f"egvs sensor design, from {base.name}", assumed="",']
    assert found in ({}, {"design.py": no_command})  # of an extension


def test_hints_of_demo_and_options_are_words_of_a_shell(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run_tables.print_demo_hints(Path("my runs/demo"))
    first, second, _ = capsys.readouterr().out.splitlines()
    assert shlex.split(first.partition("next: ")[2].partition("  ")[0])[2] == "my runs/demo"
    assert shlex.split(second.partition("  (")[0])[2] == "my runs/demo"
    with pytest.raises(InputError, match=r"egvs explore --to 'my page\.html'"):
        options._check_folder_name(Path("my page.html"))
    map_file = tmp_path / "my map.osm"
    map_file.write_text("<osm version='0.6'></osm>")
    with pytest.raises(InputError, match=r"--from 'my map\.osm'"):
        network.check_is_no_map(map_file)
