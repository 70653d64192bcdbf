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
