"""The rows of ``blindspots.parquet``: of each site, how many vehicles it sees at each spot."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artefacts import blindspots, tables
from pipeline.artefacts.tables import TableWriter
from pipeline.core.grid import Grid
from pipeline.scoring.blindspots.spots import CELL, CELL_M, SiteSeen, Spots
from pipeline.scoring.targets.scores import SEEN_WELL_POINTS

ARTEFACT = "blindspots"


class SpotWriter:
    """Writes ``blindspots.parquet`` site by site. Made by :func:`writer`."""

    def __init__(self, file: TableWriter, spots: Spots, sites: int) -> None:
        self._file, self._weights, self._at_once = file, spots.weights, blindspots.sites_a_group(sites)
        self._where = {name: list(values) for name, values in _where(spots).items()}
        self._waiting: list[tuple[str, SiteSeen]] = []

    def add(self, site: str, its: SiteSeen) -> None:
        """Append a site."""
        self._waiting.append((site, its))
        if len(self._waiting) == self._at_once:
            self._write()

    def describe(self, about: dict[str, Any]) -> None:
        """Set the metadata, of which ``grid`` says where squares are counted from; no site comes after."""
        if self._waiting:
            self._write()
        grid = Grid.from_json(about["grid"])
        cells = {"origin_m": list(grid.origin_m[:2]), "cell_m": CELL_M, "shape": list(cells_over(grid))}
        self._file.describe({**about, "cells": cells, "points": SEEN_WELL_POINTS})

    def _write(self) -> None:
        names, seen = zip(*self._waiting, strict=True)
        many: dict[str, Any] = {name: values * len(seen) for name, values in self._where.items()}
        many["site"] = [name for name in names for _ in self._weights]
        for column, of in (("seen", "seen"), ("share_seen", "share"), ("share_se", "se")):
            many[column] = np.concatenate([getattr(its, of) for its in seen])
        self._file.write({**many, "weight": np.tile(self._weights, len(seen))})
        self._waiting.clear()


@contextmanager
def writer(path: Path, spots: Spots, sites: int, *, mixed: bool) -> Iterator[SpotWriter]:
    """Open ``blindspots.parquet`` for so many sites; it appears when the block ends well.

    ``mixed``: whether the traffic is a mix of periods.
    """
    with tables.writer(path, ARTEFACT, ("weight",) if mixed else ()) as file:
        yield SpotWriter(file, spots, sites)


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
