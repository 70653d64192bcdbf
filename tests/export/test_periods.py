"""Where traffic has periods, a site also has the scores of each alone."""

from __future__ import annotations

import csv
from pathlib import Path

import egvs
from egvs.artefacts.readers import read_scores, read_scores_by_period
from egvs.export.export import export_run
from tests.scoring.test_periods import PERIODS


def test_a_site_has_the_scores_of_each_period(mini: Path, tmp_path: Path) -> None:
    """One of them is called so that its columns could be taken for others."""
    file = mini / "scenario.toml"
    periods = PERIODS.replace('"night"', '"SE"')
    file.write_text(file.read_text().replace("[[traffic.kinds]]", f"{periods}\n[[traffic.kinds]]", 1))
    run = tmp_path / "run"
    egvs.run(egvs.load(mini), run)
    export_run(run, "csv", out=tmp_path / "out")
    with (tmp_path / "out" / "sites.csv").open(encoding="utf-8-sig", newline="") as table:
        rows = {row["site"]: row for row in csv.DictReader(table)}
    scores = read_scores(run / "scores.parquet").to_pylist()
    alone = read_scores_by_period(run / "scores_by_period.parquet").to_pylist()
    assert {row["period"] for row in alone} == {"day", "SE"}
    assert [rows[row["site"]]["egvs_se"] for row in scores] == [repr(row["egvs_se"]) for row in scores]
    for row in alone:
        of, period = rows[row["site"]], row["period"]
        for name in ("egvs", "rank", "egvs_se", "entropy_seen"):
            assert of[f"{name}_in_{period}"] == repr(row[name])
