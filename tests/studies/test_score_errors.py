"""Errors and rankings with ties; the recommended setting is the cheapest, or a familiar one that is nearly as cheap."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from egvs.studies import score_errors
from egvs.studies.score_errors import SettingResult

BLANK = {"str": "", "float": 0.0, "int": 0, "bool": False}


def row(setting: str, seconds: float, judged: float = 0.01, **more: object) -> SettingResult:
    blank = {field.name: BLANK[str(field.type)] for field in fields(SettingResult)}
    kind = "scenario" if setting == "own" else "approximates"
    return SettingResult(**{**blank, "setting": setting, "kind": kind, "seconds": seconds, "judged": judged, **more})


@pytest.mark.parametrize(
    ("rows", "expected"),
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
def test_recommends_familiar_setting_unless_another_saves_a_fifth(
    rows: list[SettingResult], expected: str | None
) -> None:
    chosen = [marked.setting for marked in score_errors.mark_pareto_front(rows, 0.02) if marked.recommended]
    assert chosen == ([] if expected is None else [expected])


def test_rank_agreement_best_sites_and_regret_with_ties() -> None:
    a, b = np.array([3.0, 3.0, 1.0, 2.0]), np.array([4.0, 3.0, 1.0, 2.0])
    pairs = [(i, j) for i in range(4) for j in range(i)]
    signs = [(np.sign(a[i] - a[j]), np.sign(b[i] - b[j])) for i, j in pairs]
    agree = sum(x * y for x, y in signs) / np.sqrt(sum(x != 0 for x, _ in signs) * sum(y != 0 for _, y in signs))
    assert score_errors.rank_agreement(a, b, "tau") == pytest.approx(agree)
    assert score_errors.rank_agreement(np.ones(3), np.ones(3), "rho") == 1.0
    assert score_errors.rank_agreement(np.ones(4), b, "tau") == 0.0
    assert score_errors.best_sites(a, 1) == {0, 1}
    assert score_errors.best_sites(b, 3) == {0, 1, 3}
    assert score_errors.regret(a, b) == pytest.approx(0.25)  # of two that tie, the worse
    assert score_errors.regret(b, a) == 0.0
    assert score_errors.relative_errors(np.array([0.0, 1.0]), np.array([0.0, 0.0])).tolist() == [0.0, np.inf]
