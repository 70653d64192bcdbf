"""The vector layers of a city's run: junctions, the plan, the candidate sites of all junctions."""

from __future__ import annotations

from pathlib import Path

from pipeline.artefacts import tables
from pipeline.city.results import junctions, plan
from pipeline.core.errors import InputError
from pipeline.export.finished_run import FinishedRun
from pipeline.export.layers import JUNCTIONS, PLAN, SITES, Layer, plain, points

_NAMED = "junction"


def is_city(folder: Path) -> bool:
    """Whether a folder is that of a city's run."""
    return (folder / junctions.TABLE).is_file()


def name_of(folder: Path) -> str:
    """The city's name."""
    return str(tables.read_metadata(folder / junctions.TABLE, "city")["city"]["name"])


def any_run(folder: Path) -> FinishedRun:
    """The run of one of its junctions: all of them lie in one reference system."""
    return FinishedRun.open(junctions.run_folder(folder, _names(folder)[0]))


def layers_of_city(folder: Path) -> tuple[list[Layer], list[str]]:
    """The layers that a city's run has, those on top first, and what was left out and why, in words.

    InputError where a junction's scores are other ones by now than those of the city's run.
    """
    rows, about = tables.read(folder / junctions.TABLE, "city")
    if about["inputs"] != junctions.digest_of(folder, _names(folder)):
        found = "is not of the junctions' scores as they are now"
        raise InputError(folder / junctions.TABLE, found, "egvs city run makes it anew")
    layers, notes = [Layer(JUNCTIONS, points(rows), plain(rows), "gain")], list[str]()
    scores = junctions.read_scores(folder)
    planned = plan.read(folder, _names(folder))
    if planned is not None and planned.sensors:
        sensors, _ = tables.read(folder / plan.PLAN, "city_plan")
        layers.append(Layer(PLAN, points(sensors), plain(sensors)))
    elif planned is None and (folder / plan.PLAN).is_file():
        notes.append("the plan is left out: it was made of other junctions or settings; egvs city place makes it anew")
    first = ["rank", *(name for name in scores.column_names if name != "rank")]
    layers.append(Layer(SITES, points(scores), plain(scores.select(first)), about["rank_by"]))
    return layers, notes


def _names(folder: Path) -> list[str]:
    """The junctions of the run, sorted."""
    names: list[str] = tables.read(folder / junctions.TABLE, "city")[0].column(_NAMED).to_pylist()
    return sorted(names)
