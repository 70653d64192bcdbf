"""Layers of a run: scores of periods, and the plan as long as it is a plan of this run."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import egvs
from egvs.artefacts.readers import read_scores, read_scores_by_period
from egvs.export.export import export_run
from tests.scoring.test_periods import PERIODS


@pytest.mark.slow
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


Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def planned(local: Path, tmp_path: Path) -> Path:
    """A copy of a run, with a plan in its folder."""
    shutil.copytree(local.parent, tmp_path / "copy")
    folder = tmp_path / "copy" / "run"
    egvs.place(egvs.load(tmp_path / "copy" / "mini", ["placement.count=1"]), folder)
    return folder


@pytest.mark.slow
def test_plan_is_a_layer_until_the_run_changes(planned: Path, tmp_path: Path, run_egvs: Call) -> None:
    code, output, _ = run_egvs("export", planned, "--to", "csv", "--out", tmp_path / "a")
    assert (code, "plan" in output.splitlines()[0]) == (0, False)
    with (tmp_path / "a" / "plan.csv").open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    places = {"pole_a": ("10.0", "12.0"), "pole_b": ("30.5", "-12.0")}
    assert [(row["order"], row["easting_m"], row["northing_m"]) for row in rows] == [("1", *places[rows[0]["site"]])]
    egvs.run(egvs.load(planned.parent / "mini", ["roi.voxel_m=1"]), planned)
    code, output, _ = run_egvs("export", planned, "--to", "csv", "--out", tmp_path / "b")
    assert code == 0
    assert output.startswith("the plan is left out: it is for other traffic, sites or settings. Run egvs place again")
    assert not (tmp_path / "b" / "plan.csv").exists()


@pytest.mark.slow
def test_rejects_a_damaged_plan(planned: Path, tmp_path: Path, run_egvs: Call) -> None:
    path = planned / "placement.parquet"
    path.write_bytes(path.read_bytes()[:-9])
    code, _, err = run_egvs("export", planned, "--to", "csv", "--out", tmp_path / "a")
    assert code == 2
    assert "placement.parquet: does not match its checksum in placement.sha256. Remove it, or run egvs" in err
