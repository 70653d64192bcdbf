"""Replicates of joint scores of a junction, compared with slow computations from the artefacts."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.tpog import PeriodBlocks, read_periods
from egvs.core.grid import FloatArray
from egvs.extensions.city.replicates import CityBlocks, JointReplicates, common_blocks
from egvs.extensions.city.tasks import Job
from egvs.placement import problem_builder
from egvs.placement.plan import REQUIRED_STAGES
from egvs.placement.problem_builder import PlacementProblem
from egvs.runs import run
from egvs.runs.run_context import open_folder
from egvs.scoring.target_scores import DETECTORS, detection_chances
from egvs.stages.base import StageContext
from egvs.stages.site_scans import empty_scans
from egvs.stages.site_scoring import TargetScorer
from tests.conftest import write_mini


def build(folder: Path, *overrides: str) -> tuple[StageContext, PlacementProblem]:
    scenario = egvs.load(write_mini(folder / "mini"), overrides)
    run.run(scenario, folder / "run", only=REQUIRED_STAGES)
    context = open_folder(scenario, folder / "run", jobs=1)
    return context, problem_builder.build_problem(context, lambda _: None)


def without_each_block(frames: int, period: PeriodBlocks) -> list[set[int]]:
    """Return the frames that are left without each block."""
    size = period.block_frames
    return [set(range(frames)) - set(range(b * size, (b + 1) * size)) for b in range(period.blocks)]


def vehicles_found_by_plan(
    context: StageContext, problem: PlacementProblem, sites: list[str], mean: float
) -> FloatArray:
    """Return the vehicles found by all sites: with all frames, and without each block, from loops over vehicles."""
    view: Any = problem.views[-1]
    totals = [0.0] * view.n_cells
    for site in sites:
        row = problem.visibilities[-1].row(problem.names.index(site))
        for cell, amount in zip(row.cells.tolist(), row.amounts.tolist(), strict=True):
            totals[cell] += amount / view.unit
    record = view.targets.record
    frames = record.numbers[record.frame].tolist()
    (period,) = read_periods(context.folder.tpog)

    rows = parquet.read_artefact(context.folder.trajectories, "trajectories")[0].to_pylist()
    roi = context.scenario.roi.box
    near = []
    for row in rows:
        radius = 0.5 * math.sqrt(row["length_m"] ** 2 + row["width_m"] ** 2 + row["height_m"] ** 2)
        centre = (row["x_m"], row["y_m"], row["z_m"])
        sides = zip(centre, roi.origin_m, roi.size_m, strict=True)
        if all(low - radius < at < low + size + radius for at, low, size in sides):
            near.append(row["frame"])

    found = []
    for left in [set(range(period.frames)), *without_each_block(period.frames, period)]:
        values = [1.0 - math.exp(-total) for total, frame in zip(totals, frames, strict=True) if frame in left]
        share = sum(values) / len(values) if values else 0.0
        found.append(share * sum(frame in left for frame in near) / len(left))
    assert found[0] == pytest.approx(mean * sum(1.0 - math.exp(-t) for t in totals) / len(totals))
    return np.array(found)


def expected_vehicles_by_detector(context: StageContext, sites: list[str], mean: float) -> list[float]:
    """Return how many of the vehicles some sites together find on average, by each detector."""
    targets = TargetScorer(context, context.scenario.roi.grid)
    found = []
    for detector in DETECTORS:
        missed = np.ones(len(targets.record))
        for scan in empty_scans(context, sites):
            missed *= 1.0 - detection_chances(targets.visible(scan.beams), (detector,))
        found.append(mean * float(np.mean(1.0 - missed)))
    return found


def slow_egvs(context: StageContext, problem: PlacementProblem, sites: list[str]) -> FloatArray:
    """Return the joint EGVS with all frames, and without each block, voxel by voxel."""
    view: Any = problem.views[-1]
    hits: dict[int, float] = {}
    for site in sites:
        row = problem.visibilities[-1].row(problem.names.index(site))
        for cell, amount in zip(row.cells.tolist(), row.amounts.tolist(), strict=True):
            voxel = int(view.voxels[cell])
            hits[voxel] = hits.get(voxel, 0.0) + amount / view.unit
    (period,) = read_periods(context.folder.tpog)
    shape = context.scenario.roi.grid.shape
    rows = parquet.read_artefact(context.folder.tpog, "tpog")[0].to_pylist()
    scores = []
    for left_out in (None, *range(period.blocks)):
        counts: dict[int, int] = {}
        for row in rows:
            if row["block"] != left_out:
                voxel = int(np.ravel_multi_index((row["ix"], row["iy"], row["iz"]), shape))
                counts[voxel] = counts.get(voxel, 0) + row["count"]
        frames = period.frames - (0 if left_out is None else period.block_frames)
        score = 0.0
        for voxel, count in counts.items():
            p = count / frames
            if 0.0 < p < 1.0:
                entropy = -p * math.log2(p) - (1 - p) * math.log2(1 - p)
                score += entropy * min(context.scenario.gamma, hits.get(voxel, 0.0))
        scores.append(score)
    return np.array(scores)


@pytest.mark.slow
@pytest.mark.parametrize("score", ["expected_detections", "egvs"])
def test_replicates_equal_scores_without_each_block(tmp_path: Path, score: str) -> None:
    context, problem = build(tmp_path, f'score.rank_by="{score}"')
    (period,) = read_periods(context.folder.tpog)
    blocks = CityBlocks((replace(period, memory_frames=1e-3),))  # so that every block is a group
    assert [len(groups.frames) for groups in blocks.groups] == [period.blocks]
    mean = float(run.RunRecord.read(context.folder.path).stages["tpog"].summary["boxes_in_roi"])
    sites = problem.names[:2]
    actual = JointReplicates(context, problem, blocks, mean).of_order(sites)
    n_detectors = 2 if score == "expected_detections" else 0
    assert actual.shape == (3, 1 + period.blocks + n_detectors)
    assert not actual[0].any()
    for n in (1, 2):
        if score == "egvs":
            expected = slow_egvs(context, problem, sites[:n])
        else:
            expected = vehicles_found_by_plan(context, problem, sites[:n], mean)
        assert actual[n, : 1 + period.blocks] == pytest.approx(expected, rel=1e-9)
        if n_detectors:
            expected = expected_vehicles_by_detector(context, sites[:n], mean)[::-1]  # without one, by the other
            assert actual[n, 1 + period.blocks :] == pytest.approx(expected, rel=1e-9)
    assert len(set(actual[2].tolist())) > 2


@pytest.mark.slow
def test_blocks_are_common_or_the_reason_is_named(tmp_path: Path) -> None:
    jobs = []
    for name, blocks in (("a", 10), ("b", 10), ("c", 5)):
        folder = write_mini(tmp_path / name)
        override = f"tpog.blocks={blocks}"
        run.run(egvs.load(folder, [override]), tmp_path / "out" / name, only=REQUIRED_STAGES)
        jobs.append(Job(name, folder, tmp_path / "out" / name, (override,)))
    common = common_blocks(jobs[:2])
    assert isinstance(common, CityBlocks)
    times = [read_periods(job.out / "tpog.parquet")[0].memory_frames for job in jobs[:2]]
    assert common.periods[0].memory_frames == max(times)
    assert common_blocks(jobs) == "junctions a and c have different frames or blocks"
    assert common.detectors == ()
    ranked = ("tpog.blocks=10", "score.rank_by='expected_detections'")
    by_all = [Job(job.junction, job.folder, job.out, ranked) for job in jobs[:2]]
    both = common_blocks(by_all)
    assert isinstance(both, CityBlocks) and both.detectors == DETECTORS
    by_one = Job("b", jobs[1].folder, jobs[1].out, (*ranked, "score.detector='cluster'"))
    assert common_blocks([by_all[0], by_one]) == "junctions a and b have different detectors"
    without = Job("b", jobs[1].folder, jobs[1].out, ("score.standard_error=false",))
    assert common_blocks([jobs[0], without]) == "score.standard_error is false at junction b"
