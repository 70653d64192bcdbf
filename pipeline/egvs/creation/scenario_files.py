"""Write the files of a new scenario: ``scenario.toml``, ``statics.geojson``, ``sites.csv``.

:func:`publish_folder` writes them to a temporary folder and renames it, so that a folder is complete or absent. The
functions that make single tables of ``scenario.toml`` are also used for the junctions of a city.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import TypeAdapter, ValidationError
from shapely.geometry.base import BaseGeometry

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import name_in_errors
from egvs.creation import junctions
from egvs.creation.junctions import JunctionRegion, KerbsidePole
from egvs.creation.map_parts import ImportCounts, MappedSolid
from egvs.creation.plain_network import NETWORK_FILE
from egvs.scenario.fields import Name
from egvs.scenario.model import RoiConfig
from egvs.scenario.score_config import DEFAULT_SCORE, ScoreConfig
from egvs.scenario.signal_config import SignalConfig
from egvs.scenario.traffic_config import COUNT_IDS, COUNT_NAMES, CountConfig, VehicleKind
from egvs.sensors.sensor import CATALOGUE
from egvs.traffic.approach_names import approach_name
from egvs.traffic.directions import arrival_side
from egvs.traffic.movements import MovementNames

STATICS_FILE, SITES_FILE, TERRAIN_FILE = "statics.geojson", "sites.csv", "terrain.ply"
ZONES_FILE, COUNTS_FILE, SIGNALS_FILE = "zones.geojson", "counts.csv", "signals.csv"
SENSOR = "VLP-32C"

PITCHES_DEG = (0.0, -5.0, -10.0)
"""Tilts to try at each height, in equal steps from level: :data:`SENSOR` sees all around.

The best one depends on sensor, height and junction. "aim" is for sensors with a narrow field of view: the middle ray of
:data:`SENSOR` is 5 degrees below level, so that from a low pole it would point its nose up."""

TomlTable = tuple[str, dict[str, Any]]
"""A comment, and the keys of a table."""

_KEY_COMMENTS = {  # of tables and keys; the table of a key above all tables is ""
    ("", "assumed"): "shown with the ranking; remove what you replace by measurements",
    ("traffic", "junction_blocker_s"): "vehicles drive through one that blocks them; overlaps are counted",
    ("traffic", "teleport_s"): "the last resort against locks; moved vehicles are counted",
    ("score", "rank_by"): "the share of vehicles that detectors should find",
    ("score", "zones"): "areas with results of their own",
    ("sites", "existing_poles"): "poles that stand already, or 'all': they cost nothing",
    ("sites", "sensor"): "or a list: each is a candidate",
    ("sites", "aim"): "the centre of the region",
    ("sites", "pitch_deg"): "each is tried at each height; 'aim' points the central ray at the centre",
}


def check_new_folder(folder: Path) -> str:
    """Check that a new folder can be made.

    Parameters
    ----------
    folder
        Where the scenario or city will be.

    Returns
    -------
    str
        A name for the scenario if the folder's own name is not a valid one, otherwise an empty string.

    Raises
    ------
    InputError
        When there is a file or a folder with content.
    """
    hint = "Choose a folder that does not exist yet; no file is ever overwritten."
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "expected a new folder, got an existing file", hint)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(folder, "expected a new folder, got one that is not empty", hint)
    name = folder.resolve().name
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        return re.sub(r"[\s/\\:*?\"<>|]+", "-", name).strip("-") or "junction"
    return ""


def solids_geojson(solids: Sequence[MappedSolid], counts: ImportCounts, attributions: Sequence[str]) -> str:
    """Return GeoJSON in world-frame metres, one feature per line, with the import counts in its head."""
    head = {
        "type": "FeatureCollection",
        "attribution": "; ".join(attributions),
        "frame": f"metres, x and y of {NETWORK_FILE}; not longitude and latitude",
        "crs": None,
        "summary": counts.to_json(),
    }
    opening = json.dumps(head, indent=1, ensure_ascii=False).removesuffix("\n}")
    lines = ",\n".join(json.dumps(solid.to_geojson(), ensure_ascii=False) for solid in solids)
    return f'{opening},\n "features": [\n{lines}\n]}}\n'


def sites_csv(poles: Sequence[KerbsidePole], columns: Mapping[str, FloatArray] | None = None) -> str:
    """Return the table of candidate sites.

    Parameters
    ----------
    poles
        Locations.
    columns
        Further columns by name, (n,) each.
    """
    digits = max(2, len(str(len(poles))))
    rows = [f"{pole.name or f'k{number:0{digits}d}'},{pole.x_m},{pole.y_m}" for number, pole in enumerate(poles, 1)]
    header = "site,x_m,y_m"
    if any(pole.source for pole in poles):
        header += ",source,moved_m"
        rows = [f"{row},{pole.source},{pole.moved_m:g}" for row, pole in zip(rows, poles, strict=True)]
    for name, values in (columns or {}).items():
        header += f",{name}"
        rows = [f"{row},{value:g}" for row, value in zip(rows, values.tolist(), strict=True)]
    return "\n".join([header, *rows, ""])


def reachable_area(roi: JunctionRegion) -> BaseGeometry:
    """Return where beams end that start at a candidate pole, or that reach the region of interest from anywhere."""
    margin_m = junctions.BEYOND_ROI_M + CATALOGUE[SENSOR].range_m
    return roi.area.buffer(margin_m, join_style="mitre")


def roi_table(roi: JunctionRegion, z_range_m: tuple[float, float] = (0.0, junctions.ROI_HEIGHT_M)) -> TomlTable:
    """Return ``[roi]`` without the voxel size; ``z_range_m`` is its bottom and top."""
    comment = "the box in which visibility counts, a whole number of voxels along each axis"
    low_m, high_m = z_range_m
    return comment, {"center_m": [*roi.center_m, (low_m + high_m) / 2], "size_m": [*roi.size_m, high_m - low_m]}


def voxel_keys() -> dict[str, Any]:
    """Return the keys of ``[roi]`` that set the voxel size."""
    return {"voxel_m": RoiConfig.model_fields["voxel_m"].default}


def statics_table(meshes: Sequence[str] = (), terrain: str | None = None) -> TomlTable:
    """Return ``[statics]`` with mesh files, each named after the kind of its objects, and a terrain file."""
    comment = "buildings, trees, barriers, poles, and what was assumed about them"
    keys: dict[str, Any] = {"footprints": [STATICS_FILE]}
    if meshes:
        keys["meshes"] = [{"file": name, "kind": name.removesuffix(".ply")} for name in meshes]
    if terrain is not None:
        keys["terrain"] = terrain
    return comment, keys


def sites_table(existing: Sequence[str] | None = None) -> TomlTable:
    """Return ``[sites]`` without the keys of :func:`mount_keys`.

    ``existing`` are the poles whose positions are known where all exist; None for locations along the kerbs.
    """
    poles = f"poles {junctions.KERB_M:g} m behind the kerbs"
    keys: dict[str, Any] = {"file": SITES_FILE, "existing_poles": list(existing or ())}
    if existing is not None:
        poles = "poles of the map; check those with moved_m, and add them to existing_poles"
    return f"{poles}; columns longitude, latitude (degrees) may replace x_m, y_m", keys


def mount_keys() -> dict[str, Any]:
    """Return the keys of ``[sites]`` that set sensor, heights and tilts of the candidates."""
    return {"sensor": SENSOR, "heights_m": list(junctions.HEIGHTS_M), "aim": "roi", "pitch_deg": list(PITCHES_DEG)}


def score_table(zones_file: str | None = None) -> TomlTable:
    """Return ``[score]``, with the file of the zones for which results are reported, if there are any."""
    keys = {"gamma": ScoreConfig.model_fields["gamma"].default, "rank_by": DEFAULT_SCORE}
    if zones_file is not None:
        keys["zones"] = zones_file
    return "", keys


def placement_table() -> TomlTable:
    """Return ``[placement]``: without a limit, a plan may put two sensors in the same place."""
    comment = 'for --budget, add a table [costs]: sensor = {"VLP-32C" = 8000}, pole = 2000'
    return comment, {"most_per_pole": 1}


def toml_document(comments: Sequence[str], values: Mapping[str, Any], tables: Mapping[str, TomlTable]) -> Any:
    """Make a TOML document.

    Parameters
    ----------
    comments
        Lines at the top.
    values
        Keys above all tables.
    tables
        Tables by name.

    Returns
    -------
    tomlkit.TOMLDocument
    """
    document = tomlkit.document()
    for comment in comments:
        document.add(tomlkit.comment(comment))
    document.add(tomlkit.nl())
    document.update(values)
    for key in values:
        if ("", key) in _KEY_COMMENTS:
            document[key].comment(_KEY_COMMENTS["", key])
    for table_name, (comment, keys) in tables.items():
        table = tomlkit.item(keys)
        if comment:
            table.comment(comment)
        document.add(tomlkit.nl()).add(table_name, table)
        for key in keys:
            if (table_name, key) in _KEY_COMMENTS:
                table[key].comment(_KEY_COMMENTS[table_name, key])
    return document


def counts_array(flows: Sequence[CountConfig], names: MovementNames, comments: Sequence[str] = ()) -> Any:
    """Return a TOML array with one flow per line, and its movement in words, followed by a comment of its own."""
    rows = tomlkit.array()
    for number, flow in enumerate(flows):
        movement = names.describe(flow.edge or flow.from_edge or "", flow.to_edge)
        if comments:
            movement += f"; {comments[number]}"
        rows.add_line(_count_row(flow), comment=movement)
    rows.add_line(indent="")
    return rows


def counts_csv(flows: Sequence[CountConfig], names: MovementNames) -> str:
    """Return a table of flows: their approach and turn for people, and their edges; the user overwrites the numbers."""
    rows = []
    for flow in flows:
        movement = names.movement(flow.edge or flow.from_edge or "", flow.to_edge)
        approach = approach_name(arrival_side(movement.heading), movement.street)
        ids = (flow.edge or "", flow.from_edge or "", flow.to_edge or "")
        rows.append((approach, movement.turn, movement.way_out, *ids, f"{flow.per_hour:.12g}"))
    return _csv((*COUNT_NAMES, *COUNT_IDS, "count"), rows)


def signals_csv(plan: SignalConfig) -> str:
    """Return a table of the phases of a plan; the user overwrites it."""
    rows: list[tuple[str, ...]] = []
    for number, phase in enumerate(plan.phases, start=1):
        for approach, movements in phase.green.items() or [("", ())]:
            rows.append((str(number), approach, " ".join(movements), f"{phase.green_s:g}"))
    return _csv(("phase", "approach", "movement", "green_s"), rows)


def _csv(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([header, *rows])
    return text.getvalue()


def kinds_array(kinds: Sequence[VehicleKind], comments: Sequence[Sequence[str]]) -> Any:
    """Return a TOML array with one kind of vehicle per line, each after its comments."""
    rows = tomlkit.array()
    for kind, lines in zip(kinds, comments, strict=True):
        for line in lines:
            rows.add_line(comment=line)
        rows.add_line(_inline_table(kind.model_dump(exclude_defaults=True)))
    rows.add_line(indent="")
    return rows


def _count_row(flow: CountConfig) -> Any:
    return _inline_table(flow.model_dump(exclude_defaults=True))


def _inline_table(values: Mapping[str, Any]) -> Any:
    row = tomlkit.inline_table()
    for key, value in values.items():
        row[key] = _inline_table(value) if isinstance(value, Mapping) else value
    return row


PERIODS_HINT = "For peaks, add tables [[traffic.periods]] (docs/scenarios.md, Periods)."


FileContent = str | Callable[[Path], None]
"""A text, or a function that writes a file."""


def publish_folder(folder: Path, contents: Iterable[tuple[str, FileContent]], check: Callable[[Path], object]) -> None:
    """Write files to a temporary folder, check it, and rename it: the folder appears complete or not at all.

    Parameters
    ----------
    folder
        Does not exist yet, or is empty.
    contents
        Name and content of each file.
    check
        Called with the temporary folder; raises if something is wrong with it.
    """
    target = folder.resolve()
    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for name, content in contents:
            if isinstance(content, str):
                files.write_text(partial / name, content)
            else:
                content(partial / name)
        with name_in_errors(lambda text: text.replace(os.fspath(partial), os.fspath(folder))):
            check(partial)
        if folder.is_dir():
            folder.rmdir()
        partial.replace(target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
