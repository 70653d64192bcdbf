"""A scorer gives any scan the score that the score stage would, on any thread and in any process."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.scoring.scorer import PeriodTpog, Scorer
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Pose

OCCLUSION = 'effects.moving_occlusion.method="frames"'


@pytest.fixture(params=[[], ["effects.rain.rate_mm_h=30"], [OCCLUSION]], ids=["plain", "rain", "occlusion"])
def run(request, mini, tmp_path):
    """A scenario, its scene, and the folder of its run."""
    scenario = egvs.load(mini, ["score.keep_visibility=all", *request.param])
    egvs.run(scenario, tmp_path / "run")
    return egvs.build_scene(scenario), tmp_path / "run"


def scorer_of(scene, folder) -> Scorer:
    return Scorer(scene, egvs.read_tpog(folder / "tpog.parquet"), folder / "trajectories.parquet")


def test_scorer_returns_the_scores_of_the_score_stage(run):
    scene, folder = run
    rows = {row["site"]: row for row in egvs.read_scores(folder / "scores.parquet").to_pylist()}
    scanner, scorer = Scanner(scene), scorer_of(scene, folder)
    for site in scene.sites:
        worth, hits = scorer.score_and_hits(scanner.scan_site(site))
        assert (worth.egvs, worth.entropy_seen) == (rows[site.name]["egvs"], rows[site.name]["entropy_seen"])
        assert np.array_equal(hits, egvs.read_visibility(folder / "visibility.parquet", site.name))
        assert rows[site.name]["egvs_limit"] == scorer.limit


def test_a_score_is_that_of_the_hits_of_all_voxels(run):
    """Also where a period alone has traffic that the whole has not."""
    scene, folder = run
    scanner, tpog = Scanner(scene), egvs.read_tpog(folder / "tpog.parquet")
    elsewhere = PeriodTpog("elsewhere", replace(tpog, counts=np.roll(tpog.counts, 5, axis=1)))
    for site in scene.sites:
        scan = scanner.scan_site(site)
        scorer = Scorer(scene, tpog, folder / "trajectories.parquet", periods=(elsewhere,))
        whole, _ = Scorer(scene, tpog, folder / "trajectories.parquet", periods=(elsewhere,)).score_and_hits(scan)
        assert scorer.score(scan) == whole
        assert whole.by_period[0].egvs not in (0.0, whole.egvs)


def test_hits_belong_to_the_caller_and_scores_to_no_order(run):
    scene, folder = run
    scanner, scorer = Scanner(scene), scorer_of(scene, folder)
    first, second = (scanner.scan_site(site) for site in scene.sites)
    hits = scorer.hits(first)
    kept, score = hits.copy(), scorer.score(first)
    scorer.hits(second)[:] = -1.0
    assert np.array_equal(hits, kept) and scorer.score(first) == score


@pytest.mark.slow
def test_threads_and_other_processes_get_the_same(run):
    scene, folder = run
    scanner, scorer = Scanner(scene), scorer_of(scene, folder)
    scans = [scanner.scan(Pose(8.0 + i, 14.0, 3.0), scene.sensor("small")) for i in range(12)]
    alone = [scorer_of(scene, folder).score(scan) for scan in scans]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(scorer.score, scans)) == alone
    again = pickle.loads(pickle.dumps(scorer))
    assert [again.score(scan) for scan in scans] == alone


def test_rejects_tpog_of_another_region(mini, tmp_path):
    scenario = egvs.load(mini)
    egvs.run(scenario, tmp_path / "run")
    tpog = egvs.read_tpog(tmp_path / "run" / "tpog.parquet")
    for change in ("roi.voxel_m=1.0", "roi.center_m=[21, 10, 2.5]"):
        with pytest.raises(InputError, match=r"^tpog: its Grid\(.* is not that of the scene, Grid\("):
            Scorer(egvs.build_scene(egvs.load(mini, [change])), tpog)


def test_names_the_call_that_makes_an_argument(mini):
    scene = egvs.build_scene(egvs.load(mini))
    with pytest.raises(InputError, match=r"^scene: expected a Scene, got PosixPath .*egvs\.build_scene\(scenario\)"):
        Scanner(mini)
    with pytest.raises(InputError, match=r"^tpog: expected a Tpog, got str 'tpog.parquet'.*egvs\.read_tpog\(path\)"):
        Scorer(scene, "tpog.parquet")
    with pytest.raises(InputError, match=r"^sensor: expected a Sensor, got str 'small'\. Use scene\.sensor\('small'\)"):
        Scanner(scene).scan(Pose(8.0, 14.0, 3.0), "small")


def test_traffic_to_replay_must_be_named(mini, tmp_path):
    scenario = egvs.load(mini, [OCCLUSION])
    egvs.run(scenario, tmp_path)
    with pytest.raises(InputError, match="no trajectories to replay"):
        Scorer(egvs.build_scene(scenario), egvs.read_tpog(tmp_path / "tpog.parquet"))


def test_a_new_pose_is_hidden_by_vehicles_that_no_site_has_before_it(mini, tmp_path):
    """Boxes are left out that lie outside the region of interest and the sensor: for each sensor anew."""
    scenario = egvs.load(mini, [OCCLUSION])
    egvs.run(scenario, tmp_path)
    scene = egvs.build_scene(scenario)
    far = Pose(-12.0, -2.0, 1.0)  # behind the car that comes along y = -2, beyond every site
    scan = Scanner(scene).scan(far, scene.sensor("small"))
    plain = Scorer(egvs.build_scene(egvs.load(mini)), egvs.read_tpog(tmp_path / "tpog.parquet"))
    assert 0 < scorer_of(scene, tmp_path).score(scan).egvs < plain.score(scan).egvs
