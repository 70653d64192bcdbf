"""The section of the report on a validation: shown beside the same run only, and its warnings."""

from __future__ import annotations

import base64
import html
from dataclasses import replace
from pathlib import Path

import pytest

from egvs.artefacts import parquet
from egvs.artefacts.tpog import read_tpog
from egvs.drawing.run_figures import Figures
from egvs.extensions.validation.ranking_check import DetectorCheck, RankCorrelation, RankingCheck
from egvs.extensions.validation.report_section import (
    SECTION,
    DetectorSummary,
    MeasureColumn,
    SiteDetection,
    ValidationSummary,
)
from egvs.report import page
from egvs.report.extension_sections import SectionContents
from egvs.report.page import PageContents
from egvs.results.ranking import Ranking
from tests.report.small_runs import EMPTY_BACKDROP, PageReader, render_report, run_to_scores


@pytest.mark.slow
def test_shows_the_validation_of_the_same_run(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    validate = ("validate", mini, "--out", out, "--frames", "10", "--detector", "points", "--jobs", "1")

    def section():
        text = (out / "report.html").read_text()
        return text[text.index('<section id="detected">') :].split("</section>")[0] if 'id="detected"' in text else ""

    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert not section()
    code, printed, error = run_egvs(*validate)
    assert code == 0, error
    text = html.unescape(section())
    assert f"data:image/png;base64,{base64.b64encode((out / 'validation.png').read_bytes()).decode()}" in text
    assert "in 10 frames of traffic, at least 2 s apart, with 18 vehicles in the region" in text
    assert "2 sites are too few, or too similar, to tell whether EGVS predicts detection here" in text
    assert "evaluated with the frames that the TPOG was computed from" in text and str(mini) not in text
    for row in parquet.read_artefact(out / "detection.parquet", "detection")[0].to_pylist():
        if row["objects_of"] == "vehicles":
            assert f"{100 * row['seen_20']:.1f} ± {100 * row['seen_20_se']:.1f}" in text
    assert str(out / "report.html") in printed
    assert run_egvs("verify", out)[0] == 0

    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not section()  # the scores that were validated are others
    assert run_egvs(*validate, "--set", "score.gamma=3.0")[0] == 0
    assert section()
    (out / "detection.parquet").unlink()
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not section()


@pytest.mark.slow
def test_rejects_a_damaged_validation(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("validate", mini, "--out", out, "--frames", "10", "--detector", "points", "--jobs", "1")[0] == 0
    (out / "correlation.parquet").write_bytes(b"PAR1")
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "correlation.parquet: does not match its checksum in validation.sha256. Remove it, or" in error
    (out / "validation.sha256").unlink()
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "correlation.parquet, which no run wrote" in error


def test_headline_says_that_the_validation_contradicts_the_ranking(tmp_path):
    scenario, out = run_to_scores(tmp_path)
    assert "contradicts" not in render_report(scenario, out)
    ranking, tpog = Ranking.read(out / "scores.parquet"), read_tpog(out / "tpog.parquet")
    first, best = ranking.sites[0].site, ranking.sites[1].site
    rho = RankCorrelation(0.1, -0.5, 0.6, 4)
    losing = DetectorCheck(
        "cluster", "mean AP of BEV and 3D", True, first, 0.5, best, 0.7, 0.01, 0.2, 0.02, 10, rho, None
    )
    found = {site.site: SiteDetection(0.5, 0.01, 1) for site in ranking.sites}
    summary = DetectorSummary("cluster", (MeasureColumn("BEV AP", found), MeasureColumn("mean AP", found)))

    def headline(check):
        values = ValidationSummary((summary,), RankingCheck("egvs", (check,)), 10, 18, 7.0, (), "")
        sections = (SectionContents(SECTION, values),)
        contents = PageContents(scenario, ranking, tpog, Figures("", "", None, EMPTY_BACKDROP), {}, sections=sections)
        html = page.render_page(contents)
        read = PageReader(html)
        assert "detected" in read.ids and "cluster BEV AP" in read.text and "cluster mean AP" in read.text
        return read, html[html.index("<h1>") :].split("</h1>")[0]

    read, title = headline(losing)
    assert title.endswith(", but the validation contradicts this")
    reason = f"With cluster, detection is better from {best} than from the first site, {first}, by 20.0 ± 2.0 AP points"
    assert reason in read.text
    assert read.fetched.count("#detected") == 1
    read, title = headline(replace(losing, loss_se=0.2))
    assert "contradicts" not in title and "contradicts" not in read.text


@pytest.mark.slow
def test_says_that_a_validation_of_this_run_contradicts_the_ranking(
    mini: Path, tmp_path: Path, run_egvs, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    validate = ("validate", mini, "--out", out, "--frames", "10", "--detector", "points", "--jobs", "1")
    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert run_egvs(*validate)[0] == 0
    assert "contradicts" not in run_egvs("run", mini, "--out", out)[1]
    monkeypatch.setattr(RankingCheck, "contradiction", "so")
    printed = run_egvs("run", mini, "--out", out, "--rehash")[1]  # the program seems unchanged
    assert "The validation contradicts the ranking: so." in printed
    other = run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[1]
    assert "contradicts" not in other  # the scores that were validated are others
