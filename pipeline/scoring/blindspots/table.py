"""The rows of ``blindspots.parquet``: of each site, how many vehicles it sees at each spot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import tables
from pipeline.core.grid import Grid
from pipeline.scoring.blindspots.spots import CELL, CELL_M, SiteSeen, Spots
from pipeline.scoring.targets.scores import SEEN_WELL_POINTS

ARTEFACT = "blindspots"


def write(
    path: Path, spots: Spots, sites: Sequence[str], seen: Sequence[SiteSeen], about: dict[str, Any], *, mixed: bool
) -> None:
    """Write ``blindspots.parquet``, one row group a site.

    Parameters
    ----------
    about
        Its metadata, of which ``grid`` says where squares are counted from.
    mixed
        Whether the traffic is a mix of periods.
    """
    where, weights = _where(spots), spots.weights
    with tables.writer(path, ARTEFACT, ("weight",) if mixed else ()) as file:
        for site, its in zip(sites, seen, strict=True):
            shares = {"seen": its.seen, "share_seen": its.share, "share_se": its.se, "weight": weights}
            file.write({"site": [site] * len(spots), **where, **shares})
        grid = Grid.from_json(about["grid"])
        cells = {"origin_m": list(grid.origin_m[:2]), "cell_m": CELL_M, "shape": list(cells_over(grid))}
        file.describe({**about, "cells": cells, "points": SEEN_WELL_POINTS})


def cells_over(grid: Grid) -> tuple[int, int]:
    """How many squares the region has to the east and to the north."""
    nx, ny = np.ceil(np.asarray(grid.roi.size_m[:2]) / CELL_M).astype(int).tolist()
    return nx, ny


def _where(spots: Spots) -> dict[str, Any]:
    """The columns that are the same for all sites."""
    places, cells = spots.places, len(spots.cells)
    index = np.concatenate([np.full((len(places), 2), -1), spots.cells]).astype(np.int32)
    return {
        "by": [*(place.by for place in places), *[CELL] * cells],
        "place": [*(place.name for place in places), *[""] * cells],
        "words": [*(place.words for place in places), *[""] * cells],
        "ix": index[:, 0],
        "iy": index[:, 1],
        "x_m": spots.at_m[:, 0],
        "y_m": spots.at_m[:, 1],
        "vehicle_frames": spots.vehicle_frames,
        "vehicles": spots.vehicles,
    }
