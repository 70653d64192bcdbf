"""The rasters of a run, seen from above: where traffic is, what a site sees and misses of its entropy, and which share
of the vehicles it misses.

Cells are columns of voxels, or squares of a metre. A cell in which nothing was recorded has no data.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import blindspots
from pipeline.artefacts.blindspots import BLINDSPOTS
from pipeline.artefacts.readers import read_tpog
from pipeline.export.finished_run import FinishedRun
from pipeline.report.site_views import columns_of
from pipeline.scoring.egvs import EntropyField
from pipeline.stages.shared.scans import scans

Cells = NDArray[np.float64]

OCCUPIED, SEEN, MISSED, VEHICLES = "tpog", "seen", "missed", "vehicles_missed"


@dataclass(frozen=True, eq=False)
class Raster:
    """Values on squares.

    Attributes
    ----------
    name
        Of its file, without an end.
    words, unit
        What a value says.
    values
        (nx, ny) float64, from the south-western corner; not a number where there is no data.
    origin_m, cell_m
        That corner in the world frame, and the edge of a square.
    peak
        The value at the end of the colours, which those that are looked at together share.
    """

    name: str
    words: str
    unit: str
    values: Cells
    origin_m: tuple[float, float]
    cell_m: float
    peak: float


def rasters_of(run: FinishedRun, sites: Collection[str]) -> Iterator[Raster]:
    """The TPOG, then what each of some sites sees and misses, in the order of the scans."""
    tpog = read_tpog(run.artefact("tpog.parquet"))
    x, y, _ = tpog.grid.origin_m
    origin_m, voxel_m = (x, y), tpog.grid.voxel_m
    traffic = tpog.counts.any(axis=2)
    summed = np.where(traffic, tpog.counts.sum(axis=2) / tpog.frames, np.nan)
    words = "Occupied voxels in the column on average"
    yield Raster(OCCUPIED, words, "voxel", summed, origin_m, voxel_m, _peak(summed))
    scorer = run.scorer(tpog)
    field = scorer.field
    whole = _uncertain(field, np.ones(len(field.cells), dtype=np.bool_))
    has_entropy, peak = whole > 0, _peak(whole)
    for scan in scans(run.work, sites):
        crossed = (scorer.hits(scan.beams) > 0).ravel()[field.cells]
        for name, which in ((SEEN, crossed), (MISSED, ~crossed)):
            cells = np.where(has_entropy, _uncertain(field, which), np.nan)
            words = f"Entropy in the column that {scan.site.name} {'sees' if name == SEEN else 'misses'}"
            yield Raster(f"{name}_{scan.site.name}", words, "bit", cells, origin_m, voxel_m, peak)
    if run.scenario.score.blindspots:
        for its in blindspots.read(run.artefact(BLINDSPOTS), set(sites)):
            words = f"Share of the vehicles that {its.site} misses"
            yield Raster(f"{VEHICLES}_{its.site}", words, "1", its.share_missed, its.origin_m, its.cell_m, 1.0)


def _uncertain(field: EntropyField, which: NDArray[np.bool_]) -> Cells:
    return columns_of(field, which)


def _peak(values: Cells) -> float:
    known = values[np.isfinite(values)]
    return float(known.max(initial=0.0)) or 1.0
