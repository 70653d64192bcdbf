"""Tasks of workers: scores of some sites (part.npz), failures, cached scenes, locked folders."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.extensions.city import scheduler, tasks
from egvs.extensions.city.tasks import Job, JobFailure, JobResult, Part
from egvs.runs import run
from egvs.scoring.blindspots import SpotVisibility
from egvs.scoring.scorer import SiteScore
from egvs.scoring.target_scores import SiteTargetScores
from egvs.sensors.sites import Pose, ScannedSite
from egvs.stages.site_scoring import ScoredSite
from tests.extensions.city.conftest import OVERRIDES, assert_same_run, run_separately

pytestmark = pytest.mark.system


def make_site(name: str, rng: np.random.Generator, *, full: bool) -> ScoredSite:
    """Return a site with random numbers of full precision."""
    site = ScannedSite(name, "pole", Pose(*rng.random(6).tolist()), "VLP", 100, 90, 80)
    score = SiteScore(
        float(rng.random()), float(rng.random()), rng.random(4) if full else None, {"coverage": rng.random(1)}
    )
    if not full:
        return ScoredSite(site, score, None, None, None)
    score = SiteScore(score.egvs, score.entropy_seen, score.replicates, score.shares, (score, score))
    missed = SpotVisibility(rng.integers(0, 9, 5), rng.random(5), np.array([np.nan, np.inf, 0.0, 0.1, -0.0]))
    targets = SiteTargetScores({"seen_well": np.array([np.nan, 0.1])}, ({"seen_well": float("nan")},), missed)
    index = {key: rng.integers(0, 9, 3).astype(np.int32) for key in ("ix", "iy", "iz")}
    return ScoredSite(site, score, targets, None, {**index, "hits": rng.random(3)})


def is_same(a: object, b: object) -> bool:
    """Return whether two objects are equal to the last bit, by the text of all numbers."""
    with np.printoptions(threshold=10**6, floatmode="unique"):
        return repr(a) == repr(b)


def test_reads_part_as_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    sites = [make_site("a", rng, full=True), make_site("b", rng, full=False), make_site("c", rng, full=True)]
    tasks.write_part(tmp_path / "part.npz", sites)
    read = list(tasks.read_part(tmp_path / "part.npz"))
    assert is_same([s.site for s in read], [s.site for s in sites])
    for actual, expected in zip(read, sites, strict=True):
        assert is_same((actual.score, actual.targets), (expected.score, expected.targets))
        assert is_same(actual.visible, expected.visible)
        if expected.visible is not None and actual.visible is not None:
            dtypes = {name: array.dtype for name, array in expected.visible.items()}
            assert {name: array.dtype for name, array in actual.visible.items()} == dtypes


def test_same_sites_give_same_bytes(tmp_path: Path) -> None:
    for name in ("one.npz", "two.npz"):
        tasks.write_part(tmp_path / name, [make_site("a", np.random.default_rng(3), full=True)])
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


@pytest.mark.parametrize("content", [b"", b"PK no archive", b"\x93NUMPY"])
def test_rejects_damaged_part(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "part.npz").write_bytes(content)
    with pytest.raises(InputError, match="cannot be read as partial scores"):
        list(tasks.read_part(tmp_path / "part.npz"))


@pytest.mark.slow
@given(st.integers(0, 5000), st.integers(1, 300))
def test_splits_all_sites_evenly(count: int, number: int) -> None:
    parts = tasks.split_sites(count, number)
    assert [i for part in parts for i in range(count)[part]] == list(range(count))
    sizes = [part.stop - part.start for part in parts]
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.slow
def test_lost_parts_are_scored_again(
    jobs: list[Job], tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, settings = Job("c", jobs[2].folder, jobs[2].out, OVERRIDES), scheduler.make_run_settings()
    scored = [tasks.score_part(job, settings, Part(number, 3), None) for number in range(3)]
    assert scored == [1, 1, 2]
    shutil.rmtree(next(store.glob("part-*")))
    (done,) = tasks.finish_junction(job, settings, scored)
    assert isinstance(done, JobResult)
    run_separately(job, tmp_path / "separate", monkeypatch)
    assert_same_run(job, tmp_path / "separate")


def test_failure_is_passed_on(jobs: list[Job]) -> None:
    (jobs[0].folder / "fcd.csv").unlink()
    settings = scheduler.make_run_settings()
    failure = tasks.prepare_junction(jobs[0], settings)
    assert isinstance(failure, JobFailure)
    assert "fcd.csv" in failure.message
    assert tasks.score_part(jobs[0], settings, Part(0, 2), failure) == failure
    assert list(tasks.finish_junction(jobs[0], settings, [failure, failure])) == [failure]


def test_rejects_other_version_of_program(jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    settings = scheduler.make_run_settings()
    monkeypatch.setattr("egvs.extensions.city.worker_check.__version__", "9.9.9")
    result = tasks.estimate_beams(jobs[0], settings)
    assert isinstance(result, JobFailure)
    assert "this worker runs a different version of egvs (9.9.9," in result.message


def test_cache_keeps_few_scenes(jobs: list[Job]) -> None:
    cache, folders = tasks.SceneCache(max_scenes=1), []
    for job in jobs:
        with cache.borrow("token", job) as scene:
            folders.append(scene.context.folder.path)
            with cache.borrow("token", job) as again:
                assert again is scene
    assert [folder.is_dir() for folder in folders] == [False, False, True]
    with cache.borrow("another run", jobs[2]) as other:
        assert other.context.folder.path != folders[2]


def test_cache_drops_scene_unless_in_use(jobs: list[Job]) -> None:
    cache = tasks.SceneCache()
    with cache.borrow("token", jobs[0]) as scene:
        cache.drop("token", jobs[0])
        assert scene.context.folder.path.is_dir()  # it is in use
    cache.drop("another run", jobs[0])
    assert scene.context.folder.path.is_dir()
    cache.drop("token", jobs[0])
    assert not scene.context.folder.path.exists()
    cache.drop("token", jobs[0])


@pytest.mark.slow
def test_waits_for_folder_that_lost_worker_uses(jobs: list[Job]) -> None:
    settings = scheduler.make_run_settings()
    is_locked, release = threading.Event(), threading.Event()

    def lock_folder() -> None:
        with run.lock_run_folder(jobs[0].out):
            is_locked.set()
            release.wait(30)

    other_worker = threading.Thread(target=lock_folder)
    other_worker.start()
    is_locked.wait(30)
    threading.Timer(0.3, release.set).start()
    (done,) = tasks.run_junctions([jobs[0]], settings)
    other_worker.join()
    assert isinstance(done, JobResult)
    assert done.sites == 2
