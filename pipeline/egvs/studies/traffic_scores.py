"""Scores of all mounts from parts of the traffic of one run, so that a run is simulated and scanned once.

Scores over vehicles are means over vehicle-frames. So each replayed frame keeps one sum per mount, and any set of
frames has its score at once (:meth:`RunScores.score`): shorter traffic, and fewer frames for detection. Scores over
voxels are no means; they are computed for a list of *windows*, which are consecutive blocks of the TPOG.

Where traffic has periods, a window takes the same blocks of each of them, and frames count as in the mix.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.tpog import PeriodBlocks, Tpog, block_multiplicities, read_periods, read_tpog
from egvs.artefacts.traffic_frames import spaced_frames
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.core.threads import map_ordered
from egvs.runs.run_context import open_folder
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.scoring.scorer import PeriodTpog, Scorer, SiteScore
from egvs.scoring.target_scores import DETECTORS, TARGET_SCORES, expected_by_detector
from egvs.scoring.targets import recorded_frames
from egvs.stages.base import StageContext
from egvs.stages.site_scans import SiteScan, empty_scans
from egvs.stages.site_scoring import TargetScorer


class Window(NamedTuple):
    """Consecutive blocks of the TPOG, in each period: the first of them, and their number."""

    first: int
    blocks: int


@dataclass(frozen=True, eq=False)
class RunScores:
    """Scores of n mounts from the traffic of one run.

    Attributes
    ----------
    mounts, poles
        Name and pole of each mount, in the order of the sites.
    rank_by
        Name of the score that ranks.
    block
        Block of each replayed frame in its period, (f,) int64, ascending in each period.
    weight
        Total weight of the vehicles of each frame, (f,) float64.
    sums
        Score over vehicles -> weighted sum over the vehicles of each frame, (f, n) float64.
    windows
        Windows that a score over voxels was computed for; none where a score over vehicles ranks.
    voxel_scores
        That score, (windows, n) float64; of EGVS the share of its limit.
    """

    mounts: tuple[str, ...]
    poles: tuple[str, ...]
    rank_by: str
    block: IntArray
    weight: FloatArray
    sums: Mapping[str, FloatArray]
    windows: tuple[Window, ...]
    voxel_scores: FloatArray

    def ranking_score(self, window: Window, frames: int = 0) -> FloatArray:
        """Return the score that ranks from a window, (n,) float64; ``frames`` as in :meth:`score`."""
        if self.rank_by in TARGET_SCORES:
            return self.score(self.rank_by, window, frames)
        scores: FloatArray = self.voxel_scores[self.windows.index(window)]
        return scores

    def score(self, name: str, window: Window, frames: int = 0) -> FloatArray:
        """Return a score over vehicles from a window, (n,) float64; 0 without vehicles.

        Parameters
        ----------
        name
            A key of ``sums``.
        window
            Blocks of each period.
        frames
            Number of frames, evenly spread over those of the window; all if 0.
        """
        total, weight = self.sum_over(name, window, frames)
        return total / weight if weight > 0.0 else np.zeros(len(self.mounts))

    def sum_over(self, name: str, window: Window, frames: int = 0) -> tuple[FloatArray, float]:
        """Return the sum of a score over the vehicles of a window, (n,), and of their weights; see :meth:`score`."""
        rows = np.flatnonzero((self.block >= window.first) & (self.block < window.first + window.blocks))
        rows = rows[spaced_frames(len(rows), frames)]
        return self.sums[name][rows].sum(axis=0), float(self.weight[rows].sum())

    def to_json(self) -> dict[str, Any]:
        """Return the form in which a study saves it."""
        return {
            "mounts": self.mounts,
            "poles": self.poles,
            "rank_by": self.rank_by,
            "windows": self.windows,
            "block": _encode(self.block.astype(np.float64)),
            "weight": _encode(self.weight),
            "sums": {name: _encode(sums) for name, sums in self.sums.items()},
            "voxel_scores": _encode(self.voxel_scores),
        }

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> RunScores:
        """Invert :meth:`to_json`; ValueError, KeyError or TypeError for anything else."""
        mounts = tuple(map(str, value["mounts"]))
        windows = tuple(Window(int(first), int(blocks)) for first, blocks in value["windows"])
        weight = _decode(value["weight"], None)
        sums = {str(name): _decode(text, len(mounts)) for name, text in value["sums"].items()}
        if any(len(rows) != len(weight) for rows in sums.values()):
            raise ValueError(f"expected {len(weight)} rows of sums")
        return cls(
            mounts=mounts,
            poles=tuple(map(str, value["poles"])),
            rank_by=str(value["rank_by"]),
            block=_decode(value["block"], None).astype(np.int64),
            weight=weight,
            sums=sums,
            windows=windows,
            voxel_scores=_decode(value["voxel_scores"], len(mounts)),
        )


def _encode(values: FloatArray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f8").tobytes()).decode("ascii")


def _decode(text: str, columns: int | None) -> FloatArray:
    values = np.frombuffer(base64.b64decode(text, validate=True), dtype="<f8")
    return values if columns is None else values.reshape(-1, columns)


def detector_score(detector: str) -> str:
    """Return the key of the expected detections of one detector in :attr:`RunScores.sums`."""
    return f"{DEFAULT_SCORE} of {detector}"


def score_run(
    context: StageContext, windows: Sequence[Window], sampled_frames: int, *, by_detector: bool = False
) -> RunScores:
    """Score all mounts of a run folder.

    Parameters
    ----------
    context
        The folder has trajectories, TPOG and scans.
    windows
        Windows for scores over voxels.
    sampled_frames
        Number of recorded frames that scores over vehicles use.
    by_detector
        Whether the expected detections of each detector alone are computed too.
    """
    config = context.scenario.score
    rank_by = config.rank_by
    names: list[str] = [DEFAULT_SCORE]
    if rank_by in TARGET_SCORES and rank_by != DEFAULT_SCORE:
        names.append(rank_by)
    changes = {"others": (DEFAULT_SCORE,), "standard_error": False, "blindspots": False, "keep_visibility": ()}
    score_config = config.model_copy(update={**changes, "sampled_frames": sampled_frames})
    scenario = context.scenario.model_copy(update={"score": score_config})
    work = open_folder(scenario, context.folder.path, jobs=context.threads, progress=context.progress)

    periods = read_periods(work.folder.tpog)
    targets = TargetScorer(work, scenario.roi.grid)
    frame = targets.record.frame
    n_frames = len(targets.record.numbers)
    scorer = None
    if rank_by not in TARGET_SCORES:
        grid = work.scenario.roi.grid
        tpogs = _window_tpogs(work.folder.tpog, grid, windows, periods)
        parts = tuple(PeriodTpog(str(number), tpog) for number, tpog in enumerate(tpogs))
        scorer = Scorer(work.scene, read_tpog(work.folder.tpog), work.folder.trajectories, None, parts)

    def by_frame(values: FloatArray) -> FloatArray:
        return np.bincount(frame, values, n_frames).astype(np.float64)

    def score_site(scan: SiteScan) -> _SiteSums:
        visible = targets.visible(scan.beams)
        values = {name: TARGET_SCORES[name](visible, targets.detectors) for name in names}
        if by_detector:
            values |= {
                detector_score(detector): expected_by_detector(visible, (detector,))[0] for detector in DETECTORS
            }
        sums = {name: by_frame(chances * targets.weight) for name, chances in values.items()}
        voxel_scores = np.empty(0)
        if scorer is not None:
            by_window = scorer.score(scan.beams).by_period
            limits = scorer.limits_by_period
            scores = [_voxel_score(score, rank_by, limit) for score, limit in zip(by_window, limits, strict=True)]
            voxel_scores = np.array(scores)
        return _SiteSums(scan.site.name, scan.site.pole, sums, voxel_scores)

    sites = list(map_ordered(score_site, empty_scans(work), work.threads))
    return RunScores(
        mounts=tuple(site.mount for site in sites),
        poles=tuple(site.pole for site in sites),
        rank_by=rank_by,
        block=_frame_blocks(targets.record.numbers, recorded_frames(work.folder.trajectories), periods),
        weight=by_frame(targets.weight),
        sums={name: np.column_stack([site.sums[name] for site in sites]) for name in sites[0].sums},
        windows=tuple(windows) if scorer is not None else (),
        voxel_scores=np.column_stack([site.voxel_scores for site in sites]),
    )


class _SiteSums(NamedTuple):
    mount: str
    pole: str
    sums: dict[str, FloatArray]
    voxel_scores: FloatArray


def _voxel_score(score: SiteScore, name: str, limit: float) -> float:
    if name == "egvs":
        return score.egvs / limit if 0.0 < limit < np.inf else score.egvs
    return score.entropy_seen if name == "entropy_seen" else float(score.shares[name][0])


def _frame_blocks(numbers: IntArray, recorded: Sequence[int], periods: Sequence[PeriodBlocks]) -> IntArray:
    """Return the block of each replayed frame in its period; frames that fill no block belong to the last one."""
    starts = np.append(0, np.cumsum(recorded[:-1]))
    period = np.searchsorted(np.cumsum(recorded), numbers, side="right")
    block_frames = np.array([record.block_frames for record in periods])
    blocks = np.array([record.blocks for record in periods])
    block: IntArray = np.minimum((numbers - starts[period]) // block_frames[period], blocks[period] - 1)
    return block


def _window_tpogs(path: Path, grid: Grid, windows: Sequence[Window], periods: Sequence[PeriodBlocks]) -> list[Tpog]:
    """Return the TPOG of each window of ``tpog.parquet``, in the mix of its periods.

    Parameters
    ----------
    path, grid
        The file, and its grid.
    windows
        Windows that end within the blocks.
    periods
        The periods of the file.
    """
    times = block_multiplicities(periods)
    number_in_period = np.concatenate([np.arange(period.blocks) for period in periods])
    counts = [np.zeros(int(np.prod(grid.shape)), dtype=np.int64) for _ in windows]
    with parquet.open_artefact(path, "tpog") as (file, _):
        for group in range(file.num_row_groups):  # one block each
            table = parquet.read_row_group(file, group, path)
            if not len(table):
                continue
            block = int(table.column("block")[0].as_py())
            index = [table.column(name).to_numpy() for name in ("ix", "iy", "iz")]
            cells = np.ravel_multi_index(index, grid.shape)
            occupied = table.column("count").to_numpy().astype(np.int64) * times[block]
            for window, total in zip(windows, counts, strict=True):
                if window.first <= number_in_period[block] < window.first + window.blocks:
                    total[cells] += occupied
    frames_per_block = sum(period.times * period.block_frames for period in periods)
    tpogs = []
    for window, total in zip(windows, counts, strict=True):
        tpogs.append(Tpog(grid, window.blocks * frames_per_block, total.reshape(grid.shape)))
    return tpogs
