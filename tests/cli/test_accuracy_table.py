"""How ``egvs accuracy`` ends: one recommendation with its reason, from tables made by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from rich.console import Console

from egvs.cli import accuracy_table
from egvs.cli.accuracy_table import recommendation_sentences
from egvs.studies.accuracy import AccuracyStudy
from egvs.studies.pricing import BestPole
from egvs.studies.recommendation import NeededTraffic, SettingResult, Tolerance, mark_rows
from tests.studies.test_recommendation import row

OWN = row("scenario", 8.0, 0.02, kind="scenario", probability=0.97, loss_se_points=0.01, draws=6, error=0.03)
SHORT = row("500 frames", 2.0, 0.8, probability=0.8, loss_se_points=0.2, draws=60, error=0.1)


def study_of(*rows: SettingResult, tolerance: Tolerance, **more: object) -> AccuracyStudy:
    study = AccuracyStudy(
        rows=mark_rows(rows, tolerance),
        skipped={},
        tolerance=tolerance,
        rank_by="expected_detections",
        units=6,
        is_recorded=False,
        best_pole=BestPole("c02", "c10", 0.801, 0.98),
        needed=None,
        files=(),
    )
    return replace(study, **more)


def test_names_the_cheapest_setting_its_quality_and_the_reason() -> None:
    assert recommendation_sentences(study_of(OWN, SHORT, tolerance=Tolerance(1.0))) == [
        "With all traffic of this study (6 seeds), c02 is the best pole with a probability of 98 %; c10 there "
        "should find 80.1 % of the vehicles.",
        "Recommended: 500 frames, 2.0 processor seconds instead of 8.0. The pole that it chooses is the best one with "
        "a probability of 80 %, and is expected to lose 0.80 ± 0.20 percentage points of the vehicles found.",
        "2 of 2 settings have an expected loss within the tolerance of 1 percentage point; this is the cheapest.",
    ]


def test_recommends_the_scenario_as_it_is() -> None:
    text = recommendation_sentences(study_of(OWN, SHORT, tolerance=Tolerance(0.5)))
    assert text[1].startswith("Recommended: the scenario's own setting, 8.0 processor seconds. The pole")
    assert "1 of 2 settings have an" in text[2]


def test_without_a_setting_within_the_tolerance_says_what_it_needs() -> None:
    needed = NeededTraffic(40_000.0, 33.4)
    text = recommendation_sentences(study_of(OWN, SHORT, tolerance=Tolerance(0.01), needed=needed))
    assert text[1].startswith(
        "No setting within the budget meets the tolerance of 0.01 percentage points. Recommended: the scenario's own "
        "setting, the one with the smallest expected loss, 8.0 processor seconds."
    )
    assert text[2] == (
        "The tolerance needs about 40,000 frames, 33 processor seconds (estimated from the scatter between the units)."
    )


def test_says_that_a_score_prefers_other_sites_however_long_the_traffic() -> None:
    never = NeededTraffic(math.inf, math.inf)
    study = study_of(OWN, tolerance=Tolerance(0.01), needed=never)
    assert recommendation_sentences(study)[-1] == "No feasible amount of traffic reaches the tolerance."
    by_egvs = recommendation_sentences(replace(study, rank_by="egvs"))
    assert by_egvs[-1].startswith("More traffic does not reach the tolerance: EGVS prefers other sites")


def test_tolerance_of_the_score_counts_its_error() -> None:
    text = recommendation_sentences(study_of(OWN, SHORT, tolerance=Tolerance(1.0, 0.05)))
    assert text[1].startswith("Recommended: the scenario's own setting")
    assert text[2].startswith("1 of 2 settings have an error of the score within the tolerance of 5.00 % of the score")


def test_says_where_a_model_prices_the_setting() -> None:
    modelled = replace(OWN, draws=0, probability_se=math.nan)
    (_, text, _) = recommendation_sentences(study_of(modelled, tolerance=Tolerance(1.0), is_recorded=True))
    assert "(by a model, because the study has too little independent traffic for a test)." in text


@pytest.mark.parametrize("width", [190, 120, 90])
def test_no_cell_is_cut_off_on_a_narrow_terminal(
    width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    long = row(
        "500 frames, step 0.5 s, a frame every 1 s, without sublanes", 12345.6, 12.34, loss_se_points=10.2, draws=9
    )
    monkeypatch.setattr(accuracy_table, "console", lambda *_: Console(width=width, highlight=False))
    accuracy_table.print_study(study_of(OWN, SHORT, long, tolerance=Tolerance(1.0)), "egvs run mini")
    table = capsys.readouterr().out.partition("\n* no cheaper")[0]
    assert max(map(len, table.splitlines())) <= width
    cells = table.replace("\n", " ").split()
    assert {"*=", "seconds", "loss", "chooses", "~8.0", "~2.0", "~12345.6", "0.01", "0.20", "10.20"} <= set(cells)
    assert set(long.setting.split()) <= set(cells)
