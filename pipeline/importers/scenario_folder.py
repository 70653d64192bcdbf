"""What the importer writes: scenario files with comments, footprints, tables of sites; a folder whole or not at all."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import TypeAdapter, ValidationError

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.importers import junctions
from pipeline.importers.junctions import HEIGHTS_M, ROI_HEIGHT_M, KerbPlace, Region
from pipeline.importers.mapped_solids import BUILDING_M, ImportCounts, MappedSolid
from pipeline.importers.street_network import ATTRIBUTION, NETWORK
from pipeline.scenario.models import RoiModel
from pipeline.scenario.score import RECOMMENDED, ScoreModel
from pipeline.scenario.types import Name

STATICS, SITES = "statics.geojson", "sites.csv"
SENSOR = "VLP-32C"

PITCHES_DEG: tuple[float | str, ...] = (0.0, -10.0, "aim")
"""Tilts that each height is tried with; which is best at which height depends on sensor and junction."""

Table = tuple[str, dict[str, Any]]
"""A comment, and the keys of a table."""


def check_new_folder(folder: Path) -> str:
    """The name of what is made where the folder's own is none, else nothing; InputError where something is there."""
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "is a file", "a folder that does not exist yet")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(folder, "is not empty", "a folder that does not exist yet, so that nothing is overwritten")
    name = folder.resolve().name
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        return re.sub(r"[\s/\\:*?\"<>|]+", "-", name).strip("-") or "junction"
    return ""


def geojson(mapped: Sequence[MappedSolid], counts: ImportCounts) -> str:
    """GeoJSON in world-frame metres, one feature a line."""
    head = {
        "type": "FeatureCollection",
        "attribution": ATTRIBUTION,
        "frame": f"metres, x and y of {NETWORK}; not longitude and latitude",
        "crs": None,
        "summary": counts.to_json(),
    }
    opening = json.dumps(head, indent=1, ensure_ascii=False).removesuffix("\n}")
    lines = ",\n".join(json.dumps(solid.to_geojson(), ensure_ascii=False) for solid in mapped)
    return f'{opening},\n "features": [\n{lines}\n]}}\n'


def sites_csv(places: Sequence[KerbPlace]) -> str:
    """The table of candidate sites."""
    rows = (f"k{number:02d},{place.x_m},{place.y_m}" for number, place in enumerate(places, 1))
    return "\n".join(["site,x_m,y_m", *rows, ""])


def roi_table(roi: Region) -> Table:
    """``[roi]``, without the size of voxels."""
    about = "the box whose visibility counts; its size is a whole number of voxels along each axis"
    return about, {"center_m": [*roi.center_m, ROI_HEIGHT_M / 2], "size_m": [*roi.size_m, ROI_HEIGHT_M]}


def voxels() -> dict[str, Any]:
    """The size of voxels, which is beside the region's in ``[roi]``."""
    return {"voxel_m": RoiModel.model_fields["voxel_m"].default}


def statics_table() -> Table:
    """``[statics]``."""
    about = "buildings, trees, barriers, poles; what was assumed about them is counted in the file's summary"
    return about, {"footprints": [STATICS]}


def sites_table() -> Table:
    """``[sites]``, without what :func:`mounts` says."""
    about = f"poles {junctions.KERB_M:g} m behind the kerbs of the junction; add or remove rows at will"
    return about, {"file": SITES}


def mounts() -> dict[str, Any]:
    """Sensor, heights and tilts of the candidates, in ``[sites]``."""
    return {"sensor": SENSOR, "heights_m": list(HEIGHTS_M), "aim": "roi", "pitch_deg": list(PITCHES_DEG)}


def score_table() -> Table:
    """``[score]``."""
    return "", {"gamma": ScoreModel.model_fields["gamma"].default, "rank_by": RECOMMENDED}


_COMMENTS = {
    ("score", "rank_by"): "the share of vehicles that detectors are expected to find; docs/validity.md",
    ("sites", "aim"): "sensors are turned towards the middle of the region",
    ("sites", "pitch_deg"): "each height with each tilt is a candidate; 'aim': the middle ray meets it",
}


def toml(comments: Sequence[str], values: Mapping[str, Any], tables: Mapping[str, Table]) -> Any:
    """A document of tomlkit: comments, the keys above all tables, and the tables with theirs."""
    document = tomlkit.document()
    for comment in comments:
        document.add(tomlkit.comment(comment))
    document.add(tomlkit.nl())
    document.update(values)
    for key, (comment, keys) in tables.items():
        table = tomlkit.item(keys)
        if comment:
            table.comment(comment)
        document.add(tomlkit.nl()).add(key, table)
        for name in (name for name in keys if (key, name) in _COMMENTS):
            table[name].comment(_COMMENTS[key, name])
    return document


def notes(junction_fits: bool, counts: ImportCounts) -> list[str]:
    """What to know before trusting a scenario."""
    found = []
    if not junction_fits:
        found.append(f"the junction is larger than the region of interest ({junctions.ROI_MOST_M:g} m at most)")
    heights = counts.heights.get("building", Counter())
    if guessed := heights["default"]:
        share = f"{guessed} of {heights.total()} buildings"
        found.append(f"{share} name neither height nor levels: {BUILDING_M:g} m assumed")
    return found


def publish(folder: Path, texts: Iterable[tuple[str, str]], check: Callable[[Path], object]) -> None:
    """Write the files, each a name and its text, aside, check them, and rename the folder.

    It appears whole or not at all.
    """
    partial = folder.resolve().with_name(f".{folder.resolve().name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for name, text in texts:
            files.write_text(partial / name, text)
        check(partial)
        if folder.is_dir():
            folder.rmdir()
        partial.replace(folder.resolve())
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
