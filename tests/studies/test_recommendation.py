"""The recommended setting is the cheapest within the tolerance, or else the one that loses least."""

from __future__ import annotations

from dataclasses import fields

import pytest

from egvs.results.studies import SettingResult, Tolerance
from egvs.studies.recommendation import mark_rows

BLANK = {"str": "", "float": 0.0, "int": 0, "bool": False}


def row(setting: str, seconds: float, loss_points: float = 0.0, **more: object) -> SettingResult:
    """A row of a study; all other columns are 0 or empty."""
    blank = {field.name: BLANK[str(field.type)] for field in fields(SettingResult)}
    kind = "scenario" if setting == "own" else "approximates"
    values = {"setting": setting, "kind": kind, "seconds": seconds, "loss_points": loss_points}
    return SettingResult(**{**blank, **values, **more})


OWN = row("own", 10.0, 0.1, error=0.01)
SHORT = row("short", 2.0, 0.9, error=0.08)
SHORTER = row("shorter", 1.0, 1.1, error=0.15)
CHEAP_MEASURE = row("voxel", 0.1, 0.0, kind="measures")


@pytest.mark.parametrize(
    ("tolerance", "expected"),
    [
        (Tolerance(1.0), "short"),
        (Tolerance(2.0), "shorter"),
        (Tolerance(0.5), "own"),
        (Tolerance(0.05), "own"),  # none is within it
        (Tolerance(1.0, score=0.1), "short"),
        (Tolerance(0.0, score=0.02), "own"),
        (Tolerance(1.0, score=0.001), "own"),
    ],
)
def test_recommends_the_cheapest_setting_within_the_tolerance(tolerance: Tolerance, expected: str) -> None:
    rows = mark_rows([OWN, SHORT, SHORTER, CHEAP_MEASURE], tolerance)
    assert [marked.setting for marked in rows if marked.recommended] == [expected]


def test_of_equally_cheap_settings_the_one_that_loses_less_is_recommended() -> None:
    same_cost = row("thin traffic", 2.0, 0.4)
    rows = mark_rows([OWN, SHORT, same_cost], Tolerance(1.0))
    assert next(marked.setting for marked in rows if marked.recommended) == "thin traffic"


def test_of_equally_cheap_settings_the_own_one_of_the_scenario_is_recommended() -> None:
    rows = mark_rows([OWN, row("ranked otherwise", 10.0, 0.0)], Tolerance(1.0))
    assert next(marked.setting for marked in rows if marked.recommended) == "own"


def test_settings_that_measure_something_else_are_neither_recommended_nor_on_the_front() -> None:
    marked = {result.setting: result for result in mark_rows([OWN, SHORT, CHEAP_MEASURE], Tolerance(1.0))}
    assert not (marked["voxel"].recommended or marked["voxel"].front)
    assert marked["own"].front and marked["short"].front


def test_front_has_no_setting_that_another_beats_in_time_and_loss() -> None:
    slow = row("slow", 11.0, 0.1)
    marked = {result.setting: result for result in mark_rows([slow, SHORTER, OWN, SHORT], Tolerance(1.0))}
    assert [name for name, result in marked.items() if result.front] == ["own", "shorter", "short"]


def test_rows_are_sorted_by_kind_and_seconds() -> None:
    rows = mark_rows([CHEAP_MEASURE, SHORT, OWN, SHORTER], Tolerance(1.0))
    assert [result.setting for result in rows] == ["own", "shorter", "short", "voxel"]
