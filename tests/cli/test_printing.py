"""Names are printed as they are, whatever they look like."""

from __future__ import annotations

import pytest

from pipeline.cli.tables import print_effects
from pipeline.cli.terminal import console, table
from pipeline.studies.effect_overview import Call


def test_brackets_and_colons_are_no_styles(capsys: pytest.CaptureFixture[str]) -> None:
    why = "rated_range_m under [sensors.small], or under [effects.range_limit]"
    print_effects([Call("range_limit", "score", "detect", "off", why, "")])
    words = " ".join(capsys.readouterr().out.split())
    assert "[sensors.small]" in words
    assert "[effects.range_limit]" in words
    rows = table(["[bold]"], left=())
    rows.add_row("pole:car:[red]")
    console(100).print(rows)
    assert capsys.readouterr().out.split() == ["[bold]", "pole:car:[red]"]


def test_a_bar_takes_no_name_for_markup() -> None:
    from io import StringIO

    from rich.console import Console

    from pipeline.cli.progress import Screen

    screen, shown = Screen("scan"), StringIO()
    screen._has_bar = True  # as on a terminal
    screen.progress("sensor [/x] [red]S1 :car:", 1, 2)
    Console(file=shown, width=100).print(screen._bar.get_renderable())
    assert "scan: sensor [/x] [red]S1 :car: 1/2" in shown.getvalue()
