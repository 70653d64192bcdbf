"""Which setting is recommended: the cheapest within the tolerance, unless one that nobody has to type is nearly so."""

from __future__ import annotations

from dataclasses import fields

import pytest

from egvs.studies import score_errors
from egvs.studies.score_errors import SettingResult

BLANK = {"str": "", "float": 0.0, "int": 0, "bool": False}


def row(setting: str, seconds: float, judged: float = 0.01, **more: object) -> SettingResult:
    blank = {field.name: BLANK[str(field.type)] for field in fields(SettingResult)}
    kind = "scenario" if setting == "own" else "approximates"
    return SettingResult(**{**blank, "setting": setting, "kind": kind, "seconds": seconds, "judged": judged, **more})


@pytest.mark.parametrize(
    ("rows", "right"),
    [
        ([row("own", 10.0), row("thin", 8.5)], "own"),  # saves 15 %
        ([row("own", 10.0), row("thin", 8.0)], "thin"),  # saves 20 %
        ([row("own", 10.0, judged=0.03), row("thin", 9.9)], "thin"),
        ([row("own", 10.0), row("usual", 9.0, default=True), row("thin", 8.5)], "own"),
        ([row("own", 20.0), row("usual", 9.0, default=True), row("thin", 8.5)], "usual"),
        ([row("own", 20.0), row("usual", 15.0, default=True), row("thin", 8.5)], "thin"),
        ([row("own", 10.0, judged=0.03), row("usual", 9.0, judged=0.03, default=True)], None),
    ],
)
def test_what_saves_less_than_a_fifth_is_not_worth_a_command(rows: list[SettingResult], right: str | None) -> None:
    chosen = [found.setting for found in score_errors.mark_pareto_front(rows, 0.02) if found.recommended]
    assert chosen == ([] if right is None else [right])
