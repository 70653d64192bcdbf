"""Exports a run, or a city's: vector layers as GeoPackage, GeoJSON, GeoParquet, KML or CSV, rasters as GeoTIFF.

Steps: refuse what cannot be done before any work; open the run, and choose the reference system; make the layers or
rasters; write them aside, and bring them under their names when all are whole.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pipeline.artefacts import tables as artefacts
from pipeline.core import files, plugins
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.export import city
from pipeline.export.finished_run import FinishedRun
from pipeline.export.layers import NAMES, Layer, best_site, layers_of
from pipeline.export.reference import CHOICES, DEGREES, SCENARIO, Reference

FOLDER = "export"
"""In a run's folder, where exports go by default."""


@dataclass(frozen=True)
class Format:
    """A format: how its files end, whether all layers are in one, in which system it is by default, and the libraries
    that write it."""

    name: str
    suffix: str
    is_one_file: bool
    crs: str
    libraries: tuple[str, ...]


FORMATS = {
    its.name: its
    for its in (
        Format("gpkg", ".gpkg", True, SCENARIO, ("pyogrio",)),
        Format("geojson", ".geojson", False, DEGREES, ()),
        Format("geoparquet", ".parquet", False, SCENARIO, ("geopandas",)),
        Format("kml", ".kml", True, DEGREES, ()),
        Format("csv", ".csv", False, SCENARIO, ()),
        Format("geotiff", ".tif", False, SCENARIO, ("rasterio",)),
    )
}


@dataclass(frozen=True)
class Exported:
    """What was written: files, the reference system in words, and what was left out and why."""

    paths: tuple[Path, ...]
    reference: str
    notes: tuple[str, ...]


def export(
    folder: Path,
    to: str,
    *,
    crs: str | None = None,
    out: Path | None = None,
    sites: Collection[str] = (),
    progress: Progress = silent,
) -> Exported:
    """Export a finished run.

    Parameters
    ----------
    folder
        The run's.
    to
        One of :data:`FORMATS`.
    crs
        One of :data:`pipeline.export.reference.CHOICES`; the format's own by default, and local metres where it is
        degrees and nobody knows where the scenario lies.
    out
        A file, or a folder for formats of several files; in the run's folder ``export`` by default.
    sites
        Of rasters: those whose view is written; the best one by default.

    Raises
    ------
    InputError
        Names what is unknown, missing, damaged, or cannot be written; nothing is written then.
    MissingExtraError
        Where the libraries are not installed.
    """
    its = _format(to, crs, sites)
    whole = city.is_city(folder)
    if whole and to == "geotiff":
        raise InputError("--to geotiff", f"{folder} is a city's run", f"a junction's: {folder / 'junctions' / 'NAME'}")
    run = city.any_run(folder) if whole else FinishedRun.open(folder)
    name = city.name_of(folder) if whole else run.scenario.name
    reference = _reference(run, its, crs)
    chosen = _chosen(run, sites)
    target = out or folder / FOLDER / (f"{file_name(name)}{its.suffix}" if its.is_one_file else to)
    _check_target(target, its)
    _check_free([target] if its.is_one_file else [], out)
    with files.scratch() as aside:
        if its.name == "geotiff":
            made, notes = list(_rasters(run, reference, aside, chosen, progress)), list[str]()
        else:
            layers, notes = city.layers_of_city(folder) if whole else layers_of(run)
            progress("layers made", 1, 2)
            made = list(_vectors(its, layers, reference, aside, target.name, name))
            progress("files written", 2, 2)
        paths = [target if its.is_one_file else target / path.name for path in made]
        _check_free(paths, out)
        _bring(made, paths)
    if out is None and not its.is_one_file:
        _remove_others(target, paths)
    return Exported(tuple(paths), reference.words, tuple(notes))


def _format(to: str, crs: str | None, sites: Collection[str]) -> Format:
    if to not in FORMATS:
        raise InputError("--to", repr(to), f"one of {', '.join(FORMATS)}")
    if crs is not None and crs not in CHOICES:
        raise InputError("--crs", repr(crs), f"{SCENARIO} (its reference system) or {DEGREES} (degrees)")
    if to == "kml" and crs == SCENARIO:
        raise InputError("--crs", f"{SCENARIO} with --to kml", f"{DEGREES}: KML knows degrees only")
    if sites and to != "geotiff":
        raise InputError("--site", f"with --to {to}", "--to geotiff: the other formats hold all sites")
    plugins.require(f"export to {to}", "gis", *FORMATS[to].libraries)
    return FORMATS[to]


def _reference(run: FinishedRun, its: Format, crs: str | None) -> Reference:
    choice = crs or its.crs
    if crs is None and run.frame is None and its.name != "kml":
        choice = SCENARIO
    x, y, _ = run.scenario.roi.center_m
    return Reference.of(run.frame, choice, (x, y), f"{run.work.folder}: --to {its.name}")


def _chosen(run: FinishedRun, sites: Collection[str]) -> Collection[str]:
    """The sites whose views are written; InputError for one that the run has not."""
    known = artefacts.read(run.artefact("scores.parquet"), "scores")[0].column("site").to_pylist()
    for name in sites:
        if name not in known:
            some = ", ".join(known[:10]) + (", ..." if len(known) > 10 else "")
            raise InputError("--site", f"{name!r} is no site of this run", f"one of {some}")
    return tuple(dict.fromkeys(sites)) or (best_site(run),)


def _check_target(target: Path, its: Format) -> None:
    """InputError where files could not be written, or would replace one that is no export."""
    if its.is_one_file:
        if target.suffix != its.suffix:
            raise InputError("--out", repr(str(target)), f"a file that ends in {its.suffix} for --to {its.name}")
        files.see_room(target)
        return
    if target.exists() and not target.is_dir():
        raise InputError("--out", f"{target} is a file", f"a folder: --to {its.name} writes several files")
    files.see_room(target / f"any{its.suffix}")


def _check_free(paths: Sequence[Path], out: Path | None) -> None:
    """InputError where a file that the user names, or in a folder that the user names, would be replaced: a scenario
    has a ``sites.csv`` too, and a GeoPackage may hold other layers."""
    if out is not None and (there := [path for path in paths if path.exists()]):
        right = "another name" if there[0] == out else "a new folder, or one without such files"
        raise InputError("--out", f"{there[0]} is there already", right)


def _bring(made: Sequence[Path], paths: Sequence[Path]) -> None:
    """All files to where they belong, or none."""
    for path in paths:
        files.make_room(path)
    with ExitStack() as partials:
        for path, done in zip(paths, made, strict=True):
            shutil.copyfile(done, partials.enter_context(files.aside(path)))


def _remove_others(folder: Path, paths: Sequence[Path]) -> None:
    """Remove the layers that an earlier export left in a run's folder and that are no more: a plan of other sites."""
    for layer in NAMES:
        path = folder / f"{layer}{paths[0].suffix}"
        if path not in paths:
            path.unlink(missing_ok=True)


def _vectors(
    its: Format, layers: Sequence[Layer], reference: Reference, aside: Path, name: str, title: str
) -> Iterator[Path]:
    from pipeline.export.files import geopackage, kml, tables

    each: dict[str, Callable[[Path, Layer, Reference], None]] = {
        "geojson": tables.write_geojson, "geoparquet": tables.write_geoparquet, "csv": tables.write_csv,
    }  # fmt: skip
    if its.name == "gpkg":
        geopackage.write(aside / name, layers, reference)
        yield aside / name
    elif its.name == "kml":
        kml.write(aside / name, title, layers, reference)
        yield aside / name
    else:
        for layer in layers:
            each[its.name](path := aside / f"{layer.name}{its.suffix}", layer, reference)
            yield path


def _rasters(
    run: FinishedRun, reference: Reference, aside: Path, sites: Collection[str], progress: Progress
) -> Iterator[Path]:
    from pipeline.export.files import geotiff
    from pipeline.export.rasters import rasters_of

    taken: set[str] = set()
    for number, raster in enumerate(rasters_of(run, sites), start=1):
        name = file_name(raster.name)
        while taken & (its := {name.lower(), f"{name.lower()}_colours"}):  # of sites whose names differ in signs alone
            name += "_"
        taken |= its
        yield from geotiff.write(aside, raster, reference, name)
        progress(f"{raster.name} written", number, 1 + 3 * len(sites))


def file_name(name: str) -> str:
    """A name that every disk takes."""
    return re.sub(r'[\s\x00-\x1f\x7f/\\:*?"<>|.]+', "_", name)[:80] or "_"
