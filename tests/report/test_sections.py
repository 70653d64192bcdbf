"""Sections on other commands: their sentences, and that they are shown only beside the same run."""

from __future__ import annotations

import base64
import html
from functools import partialmethod

import pytest

from egvs.artefacts import parquet
from egvs.studies import study_settings
from egvs.studies.accuracy import StudyOptions


@pytest.mark.slow
def test_shows_the_accuracy_study_of_the_same_run(mini, tmp_path, run_egvs, monkeypatch):
    """Its recommendation, the front, the figure; not of another scenario or other files; the run is verified in each
    case."""
    few = study_settings.SettingValues(
        voxels_m=(1.0,), gammas=(2.0,), thinning_factors=(), frame_periods_s=(), unnamed_effects=False
    )
    monkeypatch.setattr(StudyOptions, "__init__", partialmethod(StudyOptions.__init__, values=few))
    out = tmp_path / "out"

    def is_shown():
        return "What a right decision costs" in (out / "report.html").read_text()

    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert not is_shown()
    code, printed, error = run_egvs("accuracy", mini, "--out", out)
    assert code == 0, error
    assert str(out / "report.html") in printed.splitlines()
    text = (out / "report.html").read_text()
    assert f"data:image/png;base64,{base64.b64encode((out / 'accuracy.png').read_bytes()).decode()}" in text
    rows = parquet.read_artefact(out / "accuracy.parquet", "accuracy")[0].to_pylist()
    best = next(row for row in rows if row["recommended"])
    section = text[text.index("What a right decision costs") :]
    section = section[: section.index("</section>")]
    if best["overrides"]:  # the cheapest may be the scenario itself: times are measured
        assert f"<code>{best['overrides']}</code>" in html.unescape(section)
    assert f"expected to lose {best['loss_points']:.2f} ±" in section
    assert section.count("<tr") == 1 + sum(
        row["front"] or row["recommended"] or row["kind"] == "scenario" for row in rows
    )
    assert run_egvs("verify", out)[0] == 0

    assert run_egvs("accuracy", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not is_shown()  # that study is of another scenario than the run
    assert run_egvs("verify", out)[0] == 0
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert is_shown()
    assert run_egvs("verify", out)[0] == 0
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not is_shown()  # nor is it of other sites


@pytest.mark.slow
def test_verify_reports_a_replaced_study(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert run_egvs("accuracy", mini, "--out", out, "--budget", "0.001s")[0] == 0
    (out / "accuracy.png").write_bytes((out / "accuracy.png").read_bytes() + b"x")
    code, printed, _ = run_egvs("verify", out)
    assert code == 1
    assert "report.html shows accuracy.png, which was replaced since" in printed


@pytest.mark.slow
def test_rejects_a_damaged_study(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("accuracy", mini, "--out", out, "--budget", "0.001s")[0] == 0
    parquet.write_artefact(
        out / "accuracy.parquet",
        "scores",
        {name: [] for name in parquet.arrow_schema("scores").names},
        {"schema": 1},
    )
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "accuracy.parquet: does not match its checksum in accuracy.sha256. Remove it, or run" in error
    (out / "accuracy.sha256").unlink()  # as an earlier version left none
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "accuracy.parquet: is not an accuracy study (" in error
    assert "Remove it, or run egvs accuracy again." in error
