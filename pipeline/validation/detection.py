"""How much is detected from each site: findings against the ground truth, as ``detection.parquet``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import tables
from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core.findings import Finding
from pipeline.core.grid import Roi
from pipeline.validation.metrics.average_precision import IOUS, SUBSETS, Subset, evaluate
from pipeline.validation.metrics.leave_out import BLOCKS, Estimate, blocks_of
from pipeline.validation.metrics.matching import Objects, Record
from pipeline.validation.metrics.overlap import VIEWS
from pipeline.validation.site_findings import POINTS, Found, FoundBoxes, FoundPoints
from pipeline.validation.sweeps import Detections

ARTEFACT = "detection.parquet"
SEEN = (1, 5, 10, 20, 50)
"""Points of a vehicle that make it seen."""

ALL = "vehicles"
"""What the set of all objects is called."""

_COUNTED = (1, 5, 20)


@dataclass(frozen=True)
class SiteDetection:
    """What one detector finds from one site, of one set of objects.

    Attributes
    ----------
    objects_of
        The set: ``vehicles``, ``cars``, ``points_1`` ..
    objects, objects_with
        How many objects count; of these, by the fewest points.
    measures
        Columns of ``detection.parquet``.
    """

    site: str
    detector: str
    objects_of: str
    frames: int
    objects: int
    objects_with: Mapping[int, int]
    measures: Mapping[str, Estimate]


def measured(
    frames: Sequence[TrafficFrame], roi: Roi, found: Mapping[str, Mapping[str, Found]]
) -> tuple[list[SiteDetection], list[Finding]]:
    """Every row of ``detection.parquet``, and what is not defined.

    Parameters
    ----------
    found
        By site and detector; of each site with its points.
    """
    rows, doubts = list[SiteDetection](), list[tuple[str, str, Finding]]()
    for site, its in found.items():
        points = its[POINTS]
        assert isinstance(points, FoundPoints)
        objects = [Objects.of_wanted(frame, on, roi) for frame, on in zip(frames, points.points, strict=True)]
        nothing = Record.of(objects, [Detections.none()] * len(objects))
        seen = [_seen(nothing, subset) for subset in SUBSETS]
        for name, what in its.items():
            precise: Mapping[str, Estimate] = {}
            if isinstance(what, FoundBoxes):
                evaluation = evaluate(Record.of(objects, what.frames))
                doubts += [(site, name, doubt) for doubt in evaluation.doubts("")]
                precise = evaluation.measures
            for subset, by_points in zip(SUBSETS, seen, strict=True):
                on = nothing.points[subset.of(nothing)]
                with_ = {least: int((on >= least).sum()) for least in _COUNTED}
                own = {column: precise.get(_of(column, subset), _UNDEFINED) for column in PRECISION}
                rows.append(SiteDetection(site, name, subset.name or ALL, len(frames), len(on), with_, own | by_points))
    return rows, _together(doubts)


def _together(doubts: Sequence[tuple[str, str, Finding]]) -> list[Finding]:
    """What is the same of several sites is told once; ``doubts`` are of a site and a detector."""
    sites: dict[tuple[str, Finding], list[str]] = {}
    for site, detector, doubt in doubts:
        sites.setdefault((detector, doubt), []).append(site)
    return [
        replace(doubt, place=f"detector {detector}, site{'s' if len(its) > 1 else ''} {', '.join(its)}")
        for (detector, doubt), its in sites.items()
    ]


def write(path: Path, rows: Sequence[SiteDetection], metadata: Mapping[str, Any]) -> None:
    """Write ``detection.parquet``."""
    tables.write(path, "detection", {"site": [row.site for row in rows], **columns_of(rows)}, dict(metadata))


def columns_of(rows: Sequence[SiteDetection]) -> dict[str, list[Any]]:
    """All columns but the site's, by name."""
    columns: dict[str, list[Any]] = {
        "detector": [row.detector for row in rows],
        "objects_of": [row.objects_of for row in rows],
        "frames": [row.frames for row in rows],
        "objects": [row.objects for row in rows],
    }
    for least in _COUNTED:
        columns[f"objects_{least}"] = [row.objects_with[least] for row in rows]
    for name in MEASURES:
        columns[name] = [row.measures[name].value for row in rows]
        columns[f"{name}_se"] = [row.measures[name].se for row in rows]
    return columns


PRECISION = tuple(
    f"{kind}_iou{round(100 * iou)}"
    for iou in IOUS
    for kind in (
        *(f"ap_{view}_{steps}" for view in (*VIEWS, "combined") for steps in ("r11", "r40")),
        *(f"recall_{view}" for view in VIEWS),
    )
)
"""Measures of boxes."""

BY_POINTS = (*(f"seen_{least}" for least in SEEN), "log_points")
"""Measures that need no boxes."""

MEASURES = (*PRECISION, *BY_POINTS)
"""Columns of ``detection.parquet`` with a standard error each."""

_UNDEFINED = Estimate(math.nan, np.full(BLOCKS, math.nan), math.nan)


def _of(column: str, subset: Subset) -> str:
    return f"{column}_{subset.name}" if subset.name else column


def _seen(record: Record, subset: Subset) -> dict[str, Estimate]:
    """Shares of objects with so many points, and the mean of log(1 + points), with each block of frames left out."""
    wanted = subset.of(record)
    block = blocks_of(record.frames)
    values = np.column_stack([record.points[:, None] >= np.array(SEEN), np.log1p(record.points)])[wanted]
    kept = block[record.object_frame[wanted]] != np.arange(-1, BLOCKS)[:, None]
    count = kept.sum(axis=1)
    with np.errstate(invalid="ignore"):
        means = kept.astype(np.float64) @ values / count[:, None]
    return {name: Estimate.of(column, np.bincount(block)) for name, column in zip(BY_POINTS, means.T, strict=True)}
