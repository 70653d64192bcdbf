r"""Which site sees most of what is uncertain?

.. math:: EGVS(site) = \sum_v H(p(v)) \, \min(\gamma, hits(v))

(arXiv 2504.06772, Eq. 4): ``hits`` are the beams of the site's empty scan that cross voxel v, p comes from the TPOG.

Steps: read ``tpog.parquet``; read ``scans.parquet`` site by site (with ``scan.keep = false``: cast instead); march
every beam through the grid and count; sum; rank; say how far each score may be off because the traffic was short.
Another gamma, voxel size or TPOG needs this stage alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.readers import read_tpog
from pipeline.core import files
from pipeline.core.grid import Grid
from pipeline.core.parallel import in_order, threads
from pipeline.core.progress import Progress, silent
from pipeline.kernels import march
from pipeline.scenario.models import Scenario
from pipeline.scoring import uncertainty, visibility
from pipeline.scoring.egvs import EntropyField, Score
from pipeline.scoring.visibility import Beams, Hits, Visibility
from pipeline.sensing import scanner as survey
from pipeline.stages.base import metadata

NAME = "score"
ARTEFACTS = ("scores.parquet", "visibility.parquet")

_POSE = ("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor")
_COUNTS = ("beams", "beams_in_roi", "returns")


@dataclass(frozen=True)
class _Scored:
    about: dict[str, Any]
    score: Score
    audit: tuple[float, float, int, int] | None
    visible: dict[str, Any] | None
    left_out: NDArray[np.float64] | None


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """Gamma and what to keep; TPOG and scans by hash (without kept scans: what a scan depends on)."""
    named, also_read = _effects(scenario, out)
    own = {"name": scenario.name, "score": scenario.score.model_dump(mode="json"), **named}
    hashes = {name: files.sha256_of(out / name) for name in ("tpog.parquet", *also_read)}
    if scenario.scan.keep:
        return {"settings": own, "files": hashes | {"scans.parquet": files.sha256_of(out / "scans.parquet")}}
    return {
        "settings": own | {"scan": survey.settings(scenario, out)},
        "files": hashes | survey.file_digests(scenario, out),
    }


def run(
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    audit: bool = False,
    left_out: list[list[float]] | None = None,
) -> dict[str, Any]:
    """Score and rank all sites; write ``scores.parquet``, and ``visibility.parquet`` where sites are to be kept.

    Parameters
    ----------
    audit
        Check for every beam that the chords of its voxels add up to the clipped segment and that no voxel comes twice.
    left_out
        Where standard errors are asked for, filled with :meth:`pipeline.scoring.uncertainty.LeaveOut.scores` of each
        site.

    Returns
    -------
    dict
        ``sites``, ``best`` (names), ``egvs_limit``; with ``audit`` the worst case found.
    """
    tpog = read_tpog(out / "tpog.parquet")
    field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    gamma = scenario.score.gamma
    visible_from = Visibility(scenario, out, tpog.grid)
    leave_out = uncertainty.LeaveOut.of(out / "tpog.parquet", tpog) if scenario.score.standard_error else None
    scorer = _Scorer(visible_from, field, scenario, audit, leave_out)
    done: list[_Scored] = []
    visible: list[dict[str, Any]] = []
    for scored in in_order(scorer.score, visible_from.beams(), threads(jobs)):
        done.append(scored)
        if scored.visible is not None:
            visible.append(scored.visible)
        progress("sites", len(done), 0)
    if left_out is not None:
        left_out += (d.left_out.tolist() for d in done if d.left_out is not None)
    limit = field.limit(gamma)
    read = inputs(scenario, out)
    about = metadata(
        scenario, read, gamma=gamma, grid=tpog.grid.to_json(), frames=tpog.frames, sites=[d.about for d in done]
    )
    _write_visibility(out / ARTEFACTS[1], visible, about)
    estimate = _estimate(done, leave_out)
    columns = _columns(done, limit) | _error_columns(estimate)
    with tables.writer(out / ARTEFACTS[0], "scores", tuple(_error_columns(estimate))) as file:
        file.write(columns)
        file.describe(about)
    best = [d.about["site"] for d, rank in zip(done, columns["rank"], strict=True) if rank == 1]
    summary: dict[str, Any] = {"sites": len(done), "best": best, "egvs_limit": limit}
    if visible_from.skipped:
        summary["skipped"] = [f"{name}: {reason}" for name, reason in visible_from.skipped.items()]
    if estimate is not None:
        summary |= uncertainty.in_words(estimate, tpog.frames)
    if audit:
        summary["audit"] = _worst([d.audit for d in done if d.audit is not None])
    return summary


class _Scorer:
    """Scores one site after another, on any thread."""

    def __init__(
        self, visible: Visibility, field: EntropyField, scenario: Scenario, audit: bool, leave_out: uncertainty.LeaveOut | None
    ) -> None:
        self._visibility, self._field, self._audit, self._leave_out = visible, field, audit, leave_out
        self._gamma, self._keep = scenario.score.gamma, scenario.score.keep_visibility

    def score(self, beams: Beams) -> _Scored:
        name, unit = beams.site["site"], self._visibility.unit
        hits = self._visibility.hits(beams)
        visible = self._visible(name, hits, unit) if self._keep == "all" or name in self._keep else None
        found = audit(beams, self._field.grid) if self._audit else None
        left_out = self._leave_out.scores(hits, self._gamma, unit) if self._leave_out is not None else None
        return _Scored(beams.site, self._field.score(hits, self._gamma, unit), found, visible, left_out)

    def _visible(self, site: str, hits: Hits, unit: int) -> dict[str, Any]:
        flat = np.flatnonzero(hits)
        ix, iy, iz = (axis.astype(np.int32) for axis in np.unravel_index(flat, self._field.grid.shape))
        return {"site": [site] * len(flat), "ix": ix, "iy": iy, "iz": iz, "hits": hits[flat] / unit}


def audit(beams: Beams, grid: Grid) -> tuple[float, float, int, int]:
    """Check each beam of a site, see :func:`pipeline.kernels.march.audit`."""
    o, d, shape = visibility.in_voxels(beams, grid)
    found: tuple[float, float, int, int] = march.audit(
        o, d, shape, grid.voxel_m, np.zeros(int(np.prod(grid.shape)), dtype=np.uint32)
    )
    return found


def _columns(done: list[_Scored], limit: float) -> dict[str, Any]:
    scores = np.array([d.score.egvs for d in done])
    columns: dict[str, Any] = {name: [d.about[name] for d in done] for name in (*_POSE, *_COUNTS)}
    return columns | {
        "egvs": scores,
        "egvs_limit": np.full(len(done), limit),
        "rank": ranks(scores),
        "entropy_seen": np.array([d.score.entropy_seen for d in done]),
    }


def _estimate(done: list[_Scored], leave_out: uncertainty.LeaveOut | None) -> uncertainty.Estimate | None:
    """What leaving blocks out says of all sites; None when it is not asked for, or there is one block only."""
    if leave_out is None:
        return None
    return uncertainty.Estimate.of(np.array([d.left_out for d in done]).reshape(len(done), -1), leave_out.frames)


def _error_columns(estimate: uncertainty.Estimate | None) -> dict[str, Any]:
    """The columns of ``scores.parquet`` that say how far a score may be off."""
    if estimate is None:
        return {}
    return {"egvs_se": estimate.se, "egvs_bias": estimate.bias, "beats_next": uncertainty.beats_next(estimate)}


def _effects(scenario: Scenario, out: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Settings of the effects that act in this stage, with the sensors that they ask; the artefacts that only they
    read."""
    live, _ = visibility.acting(scenario, out)
    if not live:
        return {}, ()
    from pipeline.effects import registry as effects

    sensors = {name: model.model_dump(mode="json") for name, model in scenario.sensors.items()}
    return {"effects": effects.settings(live), "sensors": sensors}, tuple(
        name for effect in live for name in effect.reads
    )


def ranks(scores: NDArray[np.float64]) -> NDArray[np.uint32]:
    """1 for the highest score; equal scores share a rank, and the next one is left out for each that shares."""
    return np.array([1 + np.sum(scores > score) for score in scores], dtype=np.uint32)


def _worst(audits: list[tuple[float, float, int, int]]) -> dict[str, float]:
    """The worst case over all sites, see :func:`pipeline.kernels.march.audit`."""
    sums, gaps, misplaced, doubled = zip(*audits, strict=True)
    return {
        "worst_sum": max(sums),
        "longest_gap_m": max(gaps),
        "misplaced_chords": sum(misplaced),
        "voxels_visited_twice": sum(doubled),
    }


def _write_visibility(path: Path, visible: list[dict[str, Any]], about: dict[str, Any]) -> None:
    if not visible:
        path.unlink(missing_ok=True)
        return
    with tables.writer(path, "visibility") as file:
        for columns in visible:
            file.write(columns)
        file.describe(about)
