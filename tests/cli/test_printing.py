"""Names are printed as they are, whatever they look like."""

from __future__ import annotations

from dataclasses import replace

import pytest

from egvs.cli.console import Column, console, make_table
from egvs.cli.run_tables import print_effects, ranking_table
from egvs.results.ranking import RankedSite
from egvs.studies.effect_study import EffectStatus


def test_brackets_and_colons_are_no_styles(capsys: pytest.CaptureFixture[str]) -> None:
    why = "rated_range_m under [sensors.small], or under [effects.range_limit]"
    print_effects([EffectStatus("range_limit", "score", "detect", "off", why, "")])
    words = " ".join(capsys.readouterr().out.split())
    assert "[sensors.small]" in words
    assert "[effects.range_limit]" in words
    console(100).print(make_table([Column("[bold]", str)], ["pole:car:[red]"]))
    assert capsys.readouterr().out.split() == ["[bold]", "pole:car:[red]"]


@pytest.mark.parametrize("control", ["\x1b[31m", "\x9b31m", "\u202e", "\x07"])
def test_names_do_not_control_the_terminal(capsys: pytest.CaptureFixture[str], control: str) -> None:
    console(100).print(make_table([Column(f"{control}title", str)], [f"{control}pole"]))
    console(100).print(f"the best is {control}pole")
    out = capsys.readouterr().out
    assert control[0] not in out
    assert out.count(control[0].encode("unicode_escape").decode()) == 3


def test_a_bar_takes_no_name_for_markup() -> None:
    from io import StringIO

    from rich.console import Console

    from egvs.cli.console import ProgressDisplay

    screen, shown = ProgressDisplay("scan"), StringIO()
    screen._has_bar = True  # as on a terminal
    screen.progress("sensor [/x] [red]S1 :car:", 1, 2)
    Console(file=shown, width=100).print(screen._bar.get_renderable())
    assert "scan: sensor [/x] [red]S1 :car: 1/2" in shown.getvalue()


@pytest.mark.parametrize(
    ("beats_next", "text"), [(0.896, "~ 89 %"), (0.9, "90 %"), (0.612, "~ 61 %"), (0.9996, "over 99 %")]
)
def test_unclear_lead_is_not_rounded_up_to_the_limit(beats_next: float, text: str) -> None:
    site = RankedSite("a", 0.0, 0.0, 3.0, 10.0, 1, "a", 0.0, 0.0, 0.0, "s", 1e4, 1, 1, 0.5)
    sites = [replace(site, beats_next=beats_next, egvs_se=1.0), replace(site, site="b", rank=2)]
    (cells,) = [list(column.cells) for column in ranking_table(sites).columns if column.header == "beats next"]
    assert cells == [text, "-"]
