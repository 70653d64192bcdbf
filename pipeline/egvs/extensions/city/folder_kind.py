"""The folder of a city run, as ``egvs runs`` lists it and ``egvs export`` reads it.

Its layers are the junctions, the plan, the candidate sites and the regions of all junctions.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.export.finished_run import FinishedRun
from egvs.export.layers import (
    JUNCTIONS,
    PLAN,
    REGION,
    SITES,
    Layer,
    ground_heights_m,
    point_geometries,
    region_geometries,
    region_row,
    to_plain_table,
)
from egvs.extensions.city import results

_JUNCTION_COLUMN = "junction"


class CityFolder:
    """The kind, as :class:`egvs.export.folder_kinds.FolderKind` describes it."""

    name = "city"
    marker = results.JUNCTIONS_TABLE
    state = "city run"

    def title(self, folder: Path) -> str:
        """Return the name of the city."""
        return str(parquet.read_metadata(folder / results.JUNCTIONS_TABLE, "city")["city"]["name"])

    def reference_run(self, folder: Path) -> FinishedRun:
        """Open the run of the first junction; all have the same reference system."""
        return FinishedRun.open(results.junction_run_folder(folder, _junction_names(folder)[0]))

    def layers(self, folder: Path) -> tuple[list[Layer], list[str]]:
        """Return the layers, the topmost first, and notes on those that are left out.

        InputError if the scores of a junction have changed since the city run.
        """
        rows, metadata = parquet.read_artefact(folder / results.JUNCTIONS_TABLE, "city")
        if metadata["inputs"] != results.hash_scores(folder, _junction_names(folder)):
            problem = "the scores of a junction have changed since the city run"
            raise InputError(folder / results.JUNCTIONS_TABLE, problem, "Run egvs city run again.")
        layers, notes = [Layer(JUNCTIONS, point_geometries(rows), to_plain_table(rows), "gain")], list[str]()
        scores = results.read_city_scores(folder)
        planned = results.read_plan(folder, _junction_names(folder))
        if planned is not None and planned.sensors:
            sensors, _ = parquet.read_artefact(folder / results.PLAN_TABLE, "city_plan")
            ground_m = _ground_m(folder, sensors)
            layers.append(Layer(PLAN, point_geometries(sensors), to_plain_table(sensors), ground_m=ground_m))
        elif planned is None and (folder / results.PLAN_TABLE).is_file():
            notes.append("the plan is left out: it is for other junctions or settings. Run egvs city place again")
        first = ["rank", *(name for name in scores.column_names if name != "rank")]
        sites = to_plain_table(scores.select(first))
        ground_m = _ground_m(folder, scores)
        layers.append(Layer(SITES, point_geometries(scores), sites, metadata["rank_by"], ground_m=ground_m))
        layers.append(_region_layer(folder))
        return layers, notes

    def part_hint(self, folder: Path) -> str:
        """Return a sentence on how to export a junction."""
        return f"Export a junction: {folder / results.RUNS_FOLDER / 'NAME'}."


KIND = CityFolder()


def _ground_m(folder: Path, sensors: pa.Table) -> FloatArray:
    """Return z of the ground below sensors, (n,), each in the world of its junction."""
    heights_m = np.zeros(len(sensors))
    junctions = np.array(sensors.column(_JUNCTION_COLUMN).to_pylist(), dtype=object)
    for name in _junction_names(folder):
        rows = np.flatnonzero(junctions == name)
        if rows.size:
            run = FinishedRun.open(results.junction_run_folder(folder, name))
            heights_m[rows] = ground_heights_m(run.work.world, sensors.take(pa.array(rows)))
    return heights_m


def _region_layer(folder: Path) -> Layer:
    """The regions of interest of all junctions."""
    names = _junction_names(folder)
    runs = [FinishedRun.open(results.junction_run_folder(folder, name)) for name in names]
    rows = [{_JUNCTION_COLUMN: name, **region_row(run)} for name, run in zip(names, runs, strict=True)]
    return Layer(REGION, region_geometries(runs), pa.Table.from_pylist(rows))


def _junction_names(folder: Path) -> list[str]:
    """Names of the junctions, sorted."""
    names: list[str] = (
        parquet.read_artefact(folder / results.JUNCTIONS_TABLE, "city")[0].column(_JUNCTION_COLUMN).to_pylist()
    )
    return sorted(names)
