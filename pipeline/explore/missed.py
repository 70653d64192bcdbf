"""Where a moved sensor misses vehicles, as ``blindspots.parquet`` has it of the candidates."""

from __future__ import annotations

import numpy as np

from pipeline.artefacts.blindspots import PlaceSeen, SiteBlindspots
from pipeline.core.grid import Grid
from pipeline.scoring.blindspots import table
from pipeline.scoring.blindspots.spots import CELL_M, SiteSeen, Spots
from pipeline.scoring.targets.scores import SEEN_WELL_POINTS


def of_site(site: str, spots: Spots, its: SiteSeen, grid: Grid) -> SiteBlindspots:
    """What a site sees at each spot of the region of a grid."""
    count = len(spots.places)
    columns = (spots.at_m[:, 0], spots.at_m[:, 1], spots.vehicle_frames, spots.vehicles, its.share, its.se)
    rows = zip(*(column[:count].tolist() for column in columns), strict=True)
    places = tuple(PlaceSeen(place.by, place.words, *row) for place, row in zip(spots.places, rows, strict=True))
    share_missed = np.full(table.cells_over(grid), np.nan)
    share_missed[tuple(spots.cells.T)] = 1.0 - its.share[count:]
    x, y, _ = grid.origin_m
    return SiteBlindspots(site, SEEN_WELL_POINTS, places, share_missed, (x, y), CELL_M)
