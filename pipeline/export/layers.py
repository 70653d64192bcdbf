"""The vector layers of a run: candidate sites, the plan, where vehicles are missed, footprints, the region.

Geometries are shapely's, in the world frame, metres, seen from above. A column is named with its unit, as in the
artefacts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.blindspots import BLINDSPOTS
from pipeline.artefacts.period_ranking import PERIOD_SCORES
from pipeline.artefacts.readers import read_placement
from pipeline.export.finished_run import FinishedRun
from pipeline.report.drawing.outlines import united
from pipeline.report.drawing.roads import network_file
from pipeline.report.placement import PLACEMENT
from pipeline.stages.shared.world import STATICS, world_of
from pipeline.traffic import network

JUNCTIONS, SITES, PLAN, MISSED, MISSED_LANES, FOOTPRINTS, REGION = NAMES = (
    "junctions", "sites", "plan", "blindspots", "blindspot_lanes", "footprints", "region",
)  # fmt: skip
"""Layers, those on top first; a city's run alone has junctions."""

_GROUND, _CELL, _LANE = "ground", "cell", "lane"
_RESERVED = ("fid", "ogc_fid", "geom", "geometry", "wkt")
"""Names of columns that some formats have of their own."""


@dataclass(frozen=True)
class Layer:
    """Things of one kind on a map.

    Attributes
    ----------
    name
        One of :data:`NAMES`.
    geometries
        (n,) shapely geometries of one kind, world frame.
    rows
        What is known of each, n rows.
    colours_by
        The column that colours it; empty where all look the same.
    little_stands_out
        Whether small values of that column are the dark ones.
    shows
        The site whose rows a map shows at first, of a layer that has rows of each site; empty for all.
    """

    name: str
    geometries: NDArray[np.object_]
    rows: pa.Table
    colours_by: str = ""
    little_stands_out: bool = False
    shows: str = ""

    @property
    def is_of_points(self) -> bool:
        """Whether its geometries are points."""
        return self.name in (JUNCTIONS, SITES, PLAN, MISSED)

    @property
    def span(self) -> tuple[float, float] | None:
        """The lowest and the highest value of ``colours_by``; None where they do not differ, or there are none."""
        if not self.colours_by or self.colours_by not in self.rows.column_names:
            return None
        found = pc.min_max(self.rows.column(self.colours_by)).as_py()
        low, high = found["min"], found["max"]
        return (low, high) if low is not None and high > low else None


def layers_of(run: FinishedRun) -> tuple[list[Layer], list[str]]:
    """The layers that a run has, those on top first, and what was left out and why, in words."""
    notes: list[str] = []
    makers: tuple[Callable[[FinishedRun, list[str]], Iterator[Layer]], ...] = (
        _sites, _plan, _blindspots, _footprints, _region,
    )  # fmt: skip
    return [layer for make in makers for layer in make(run, notes)], notes


def best_site(run: FinishedRun) -> str:
    """The first of the sites of rank 1."""
    scores = tables.read(run.artefact("scores.parquet"), "scores")[0]
    ranked = zip(scores.column("rank").to_pylist(), scores.column("site").to_pylist(), strict=True)
    return str(min(ranked, key=lambda row: row[0])[1])


def _sites(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    del notes
    scores, about = tables.read(run.artefact("scores.parquet"), "scores")
    first = ["rank", *(name for name in scores.column_names if name != "rank")]
    rows = _with_periods(run, scores.select(first))
    yield Layer(SITES, points(scores), plain(rows), about.get("rank_by", "egvs"))


def _with_periods(run: FinishedRun, scores: pa.Table) -> pa.Table:
    """Beside the scores those of each period alone, where traffic has periods: ``rank_in_morning``."""
    if PERIOD_SCORES not in run.record.stages["score"].artefacts:
        return scores
    alone = tables.read(run.artefact(PERIOD_SCORES), "scores_by_period")[0]
    for period in alone.column("period").unique().to_pylist():
        its = alone.filter(pc.equal(alone.column("period"), period)).drop_columns(["period"])
        row = pc.index_in(scores.column("site"), its.column("site").combine_chunks())
        for name in its.drop_columns(["site"]).column_names:
            scores = scores.append_column(f"{name}_in_{period}", its.column(name).take(row))
    return scores


def _plan(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    found = read_placement(*(run.work.path(name) for name in PLACEMENT))
    if found is None:
        return
    rows, _, about = found
    if any(name not in run.record.stages or run.record.stages[name].inputs != key
           for name, key in about["stages"].items()):  # fmt: skip
        notes.append("the plan is left out: it was made of other traffic, sites or settings; egvs place makes it anew")
        return
    table = pa.Table.from_pylist(rows)
    yield Layer(PLAN, points(table), plain(table))


def _blindspots(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    """Places as points; lanes along their middle line too."""
    if not run.scenario.score.blindspots:
        notes.append("blind spots are left out: score.blindspots is off")
        return
    table, _ = tables.read(run.artefact(BLINDSPOTS), "blindspots")
    places = table.filter(pc.not_equal(table.column("by"), _CELL)).drop_columns(["ix", "iy"])
    best = best_site(run)
    yield Layer(MISSED, points(places), plain(places), "share_seen", True, best)
    lines = _lanes_of(run)
    known = [by == _LANE and name in lines for by, name in _pairs(places)]
    lanes = places.filter(pa.array(known, pa.bool_()))
    if len(lanes):
        along = np.array([lines[name] for _, name in _pairs(lanes)], dtype=object)
        yield Layer(MISSED_LANES, along, plain(lanes), "share_seen", True, best)


def _pairs(places: pa.Table) -> Iterator[tuple[str, str]]:
    return zip(places.column("by").to_pylist(), places.column("place").to_pylist(), strict=True)


def _lanes_of(run: FinishedRun) -> dict[str, Any]:
    """The middle line of each lane of the network that SUMO drove on, by SUMO's id; none where it did not run."""
    import shapely

    if (path := network_file(run.work.folder)) is None:
        return {}
    run.work.digest(path.relative_to(run.work.folder).as_posix())
    roads = network.read(path)
    lanes = ((f"{edge.id}_{which}", lane.shape_m) for edge in roads.edges for which, lane in enumerate(edge.lanes))
    return {name: shapely.LineString(shape_m[:, :2]) for name, shape_m in lanes if len(shape_m) > 1}


def _footprints(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    """Each solid of the static world from above, with its lowest and its highest point; without the ground."""
    import shapely

    del notes
    run.artefact(STATICS)
    world = world_of(run.work)
    if not len(world.faces):
        return
    low, high = world.bounds_xy_m
    (x0, y0), (x1, y1) = (low.min(axis=0) - 1.0).tolist(), (high.max(axis=0) + 1.0).tolist()
    box = x0, y0, x1, y1
    order = np.argsort(world.solid_of_face, kind="stable")
    starts = np.flatnonzero(np.diff(world.solid_of_face[order], prepend=-1))
    rows, shapes = [], []
    for faces in np.split(order, starts[1:]):
        name, kind = world.solids[int(world.solid_of_face[faces[0]])]
        corners = world.triangles_m[faces]
        shape = united(_with_area(corners[:, :, :2]), box)
        parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and part.area > 0]
        if kind == _GROUND or not parts:
            continue
        z_m = corners[:, :, 2]
        rows.append({"name": name, "kind": kind, "base_m": float(z_m.min()), "height_m": float(z_m.max())})
        shapes.append(shapely.MultiPolygon(parts))
    if rows:
        yield Layer(FOOTPRINTS, np.array(shapes, dtype=object), pa.Table.from_pylist(rows))


def _with_area(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of triangles (n, 3, 2) that are not seen on edge."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return triangles[np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > _EDGE_M2]


_EDGE_M2 = 2e-6


def _region(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    import shapely

    del notes
    roi = run.scenario.roi
    (x, y, z), (w, h, tall) = roi.box.origin_m, roi.box.size_m
    row = {
        "name": run.scenario.name, "low_m": z, "high_m": z + tall, "voxel_m": roi.voxel_m,
        "gamma": f"{run.scenario.gamma:g}", "rank_by": run.scenario.score.rank_by,
    }  # fmt: skip
    yield Layer(REGION, np.array([shapely.box(x, y, x + w, y + h)], dtype=object), pa.Table.from_pylist([row]))


def points(table: pa.Table) -> NDArray[np.object_]:
    """Where the rows of a table stand: its columns x_m and y_m."""
    import shapely

    found: NDArray[np.object_] = shapely.points(table.column("x_m").to_numpy(), table.column("y_m").to_numpy())
    return found


def plain(table: pa.Table) -> pa.Table:
    """A table that every format can hold: numbers of 64 bits, null for what is not a number, and names that differ in
    more than their case; a user's own column that is called as one here, or as one of a format, gets ``given_``."""
    columns: dict[str, Any] = {}
    taken = set(_RESERVED)
    for number, name in enumerate(table.column_names):  # names that are equal too
        column = table.column(number).combine_chunks()
        if pa.types.is_integer(column.type):
            column = column.cast(pa.int64())
        elif pa.types.is_floating(column.type):
            column = pc.if_else(pc.is_nan(column), None, column)
        free = name
        while free.lower() in taken:
            free = f"given_{free}"
        taken.add(free.lower())
        columns[free] = column
    return pa.table(columns)
