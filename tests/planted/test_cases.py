"""Small scenarios: their scores are those of an independent program, and one mistake in each is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from egvs.core.errors import Diagnostic
from tests.installed import needs
from tests.planted import truth
from tests.planted.case import Case
from tests.planted.cases import CASES
from tests.planted.outcome import outcome

TINY = ("traffic autocorrelation", "few beams")
"""Rules of warnings that all these scenarios get: 20 seconds of traffic are few, and their sensor has 840 beams."""


def marks(case: Case) -> list[pytest.MarkDecorator]:
    """What a case needs."""
    extensions = [needs(case.extension)] if case.extension else []
    return [*extensions, pytest.mark.system] if case.starts_processes else extensions


EACH = [pytest.param(case, id=case.name, marks=marks(case)) for case in CASES]


def is_about_size(finding: Diagnostic) -> bool:
    """Whether a warning says that there is little traffic, or that the sensor is small."""
    return finding.rule in TINY or "very little traffic" in finding.problem


def describe(finding: Diagnostic, folder: Path) -> tuple[str, str]:
    """Where a finding is, and what it says with its hint, without the path of the folder."""
    where, text = (part.replace(f"{folder}/", "") for part in (finding.where, f"{finding.problem} {finding.hint}"))
    return where, text


@pytest.mark.slow
@pytest.mark.parametrize("case", EACH)
def test_right_scenario_has_the_scores_of_the_oracle(case: Case, tmp_path: Path) -> None:
    scene = case.make()
    scores, findings = outcome(scene.write(tmp_path / "right"))
    assert [str(finding) for finding in findings if not is_about_size(finding)] == []
    expected = truth.scores(scene.truth) if case.scores is None else case.scores()
    assert min(expected.values()) > 1.0
    assert scores == pytest.approx(expected, rel=case.tolerance)


@pytest.mark.parametrize("case", EACH)
def test_planted_mistake_is_named(case: Case, tmp_path: Path) -> None:
    scene = case.make()
    case.plant(scene)
    folder = scene.write(tmp_path / "wrong")
    scores, findings = outcome(folder)
    matching = []
    for finding in findings:
        where, text = describe(finding, folder)
        if case.where in where and case.text in text:
            matching.append(finding)
    assert matching, [describe(finding, folder) for finding in findings]
    assert matching[0].is_error == case.is_error
    assert bool(scores) == (not any(finding.is_error for finding in findings))


def test_cases_are_complete() -> None:
    """Each has a name of its own, and says what is expected."""
    assert len({case.name for case in CASES}) == len(CASES) >= 60
    assert all(case.where and case.text for case in CASES)
