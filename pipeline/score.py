r"""Which site sees most of what is uncertain?

.. math:: EGVS(site) = \sum_v H(p(v)) \, \min(\gamma, hits(v))

(arXiv 2504.06772, Eq. 4): ``hits`` are the beams of the site's empty scan that cross voxel v, p comes from the TPOG.

Steps: read ``tpog.parquet``; read ``scans.parquet`` site by site (with ``scan.keep = false``: cast instead); march every beam through
the grid and count; sum; rank. Another gamma, voxel size or TPOG needs this stage alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline import survey, tables, visibility
from pipeline.entropy import Field, Score
from pipeline.kernels import march
from pipeline.ordered import in_order
from pipeline.grid import Grid
from pipeline.results import read_tpog
from pipeline.scenario import Scenario
from pipeline.stage import Progress, metadata, silent, threads
from pipeline.visibility import Beams, Hits, Visibility

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


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """Gamma and what to keep; TPOG and scans by hash (without kept scans: what a scan depends on)."""
    own = {"name": scenario.name, "score": scenario.score.model_dump(mode="json"), **_effects(scenario)}
    hashes = {"tpog.parquet": tables.sha256_of(out / "tpog.parquet")}
    if scenario.scan.keep:
        return {"settings": own, "files": hashes | {"scans.parquet": tables.sha256_of(out / "scans.parquet")}}
    return {"settings": own | {"scan": survey.settings(scenario)}, "files": hashes | survey.files(scenario, out)}


def run(
    scenario: Scenario, out: Path, *, jobs: int | None = None, progress: Progress = silent, audit: bool = False
) -> dict[str, Any]:
    """Score and rank all sites; write ``scores.parquet``, and ``visibility.parquet`` where sites are to be kept.

    Parameters
    ----------
    audit
        Check for every beam that the chords of its voxels add up to the clipped segment and that no voxel comes twice.

    Returns
    -------
    dict
        ``sites``, ``best`` (names), ``egvs_limit``; with ``audit`` the worst case found.
    """
    tpog = read_tpog(out / "tpog.parquet")
    field = Field.of(tpog.counts, tpog.frames, tpog.grid)
    gamma = scenario.score.gamma
    visible_from = Visibility(scenario, out, tpog.grid)
    scorer = _Scorer(visible_from, field, scenario, audit)
    done: list[_Scored] = []
    visible: list[dict[str, Any]] = []
    for scored in in_order(scorer.score, visible_from.beams(), threads(jobs)):
        done.append(scored)
        if scored.visible is not None:
            visible.append(scored.visible)
        progress("sites", len(done), 0)
    limit = field.limit(gamma)
    read = inputs(scenario, out)
    about = metadata(scenario, read, gamma=gamma, grid=tpog.grid.to_json(), frames=tpog.frames, sites=[d.about for d in done])
    _write_visibility(out / ARTEFACTS[1], visible, about)
    columns = _columns(done, limit)
    tables.write(out / ARTEFACTS[0], "scores", columns, about)
    best = [d.about["site"] for d, rank in zip(done, columns["rank"], strict=True) if rank == 1]
    summary: dict[str, Any] = {"sites": len(done), "best": best, "egvs_limit": limit}
    if audit:
        summary["audit"] = _worst([d.audit for d in done if d.audit is not None])
    return summary


class _Scorer:
    """Scores one site after another, on any thread."""

    def __init__(self, visible: Visibility, field: Field, scenario: Scenario, audit: bool) -> None:
        self._visibility, self._field, self._audit = visible, field, audit
        self._gamma, self._keep = scenario.score.gamma, scenario.score.keep_visibility

    def score(self, beams: Beams) -> _Scored:
        name, unit = beams.site["site"], self._visibility.unit
        hits = self._visibility.hits(beams)
        visible = self._visible(name, hits, unit) if self._keep == "all" or name in self._keep else None
        found = audit(beams, self._field.grid) if self._audit else None
        return _Scored(beams.site, self._field.score(hits, self._gamma, unit), found, visible)

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


def _effects(scenario: Scenario) -> dict[str, Any]:
    """The effects that act in this stage, and the sensors that they ask; nothing when the scenario names none."""
    if not scenario.effects:
        return {}
    from pipeline import effects

    named = effects.settings(effects.of(scenario, NAME))
    sensors = {name: model.model_dump(mode="json") for name, model in scenario.sensors.items()}
    return {"effects": named, "sensors": sensors} if named else {}


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
