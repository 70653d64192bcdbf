"""In a notebook, results show themselves in one informative line."""

from __future__ import annotations

from pathlib import Path

import pytest

import egvs
from egvs.sensors.sites import Pose


def test_results_are_one_informative_line(mini: Path, tmp_path: Path) -> None:
    scenario = egvs.load(mini)
    egvs.run(scenario, tmp_path / "run")
    tpog = egvs.read_tpog(tmp_path / "run" / "tpog.parquet")
    occupied = int((tpog.p > 0).sum())
    assert repr(tpog) == f"Tpog(80 x 40 x 10 voxels of 0.5 m, {occupied:,} ever occupied in 40 frames)"

    scene = egvs.build_scene(scenario)
    scan = egvs.Scanner(scene).scan(Pose(10.0, 12.0, 3.5, 33.0), scene.sensor("small"))
    assert repr(scan) == (
        "Scan(small at x, y, z = 10, 12, 3.5 m; yaw, pitch, roll = 33, 0, 0 deg; "
        f"{scan.beams_in_roi:,} of 2,880 beams towards the region, {scan.returns:,} returns)"
    )
    score = egvs.Scorer(scene, tpog).score(scan)
    assert repr(score) == f"SiteScore(egvs {score.egvs:,.1f} bit, entropy_seen {100 * score.entropy_seen:.1f} %)"


@pytest.mark.slow
def test_comparison_names_its_runs_and_their_agreement(mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\nlow,10,12,3\nhigh,10,12,4.5\nother,30.5,-12,3\n")
    for name in ("first", "second"):
        egvs.run(egvs.load(mini), tmp_path / name)
    comparison = egvs.compare_runs([tmp_path / "first", tmp_path / "second"])
    assert repr(comparison) == "Comparison(A and B by pole, 2 poles; 2 common to A and B, tau 1.00)"
    best = comparison.runs[0].ranking.best[0]
    assert repr(comparison.runs[0]) == (
        f"ComparedRun(A: {tmp_path / 'first'}, 3 sites on 2 poles, small; best {best.site}, EGVS {best.egvs:,.0f} bit)"
    )


@pytest.mark.slow
def test_rated_pose_shows_the_recommended_score_or_the_reason(mini: Path, tmp_path: Path) -> None:
    scenario = egvs.load(mini, ["score.rank_by='expected_detections'"])
    egvs.run(scenario, tmp_path / "run")
    session = egvs.open_session(str(tmp_path / "run"))
    rated = session.rate("pole_a", Pose(10.0, 12.0, 4.0))
    found = rated.scores["expected_detections"]
    assert repr(rated).startswith(f"PoseScore(pole_a: rank {rated.rank}, egvs {rated.scores['egvs']:,.0f} bit, ")
    assert f"expected_detections {100 * found:.1f} %" in repr(rated)
    inside = session.rate("pole_a", Pose(16.0, 6.0, 3.0))
    assert repr(inside).startswith("PoseScore(pole_a: no score, site pole_a: (16, 6, 3) is inside house")
