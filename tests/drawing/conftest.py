"""A small run with its report."""

from __future__ import annotations

import pytest

from tests.report.small_runs import render_report, run_to_scores


@pytest.fixture(scope="session")
def plain_run(tmp_path_factory):
    """Scenario, folder and page of a small run."""
    scenario, out = run_to_scores(tmp_path_factory.mktemp("plain"))
    return scenario, out, render_report(scenario, out)
