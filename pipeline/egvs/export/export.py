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

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core import files, plugins
from egvs.core.errors import InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.export.finished_run import CRS_CHOICES, SCENARIO_CRS, WGS84_CRS, ExportCrs, FinishedRun
from egvs.export.layers import NAMES, Layer, best_site, city_layers, city_name, is_city, open_any_run, run_layers

EXPORT_FOLDER = "export"
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
        Format("gpkg", ".gpkg", True, SCENARIO_CRS, ("pyogrio",)),
        Format("geojson", ".geojson", False, WGS84_CRS, ()),
        Format("geoparquet", ".parquet", False, SCENARIO_CRS, ("geopandas",)),
        Format("kml", ".kml", True, WGS84_CRS, ()),
        Format("csv", ".csv", False, SCENARIO_CRS, ()),
        Format("geotiff", ".tif", False, SCENARIO_CRS, ("rasterio",)),
    )
}


@dataclass(frozen=True)
class ExportResult:
    """What was written: files, the reference system in words, and what was left out and why."""

    paths: tuple[Path, ...]
    reference: str
    notes: tuple[str, ...]


def export_run(
    folder: Path,
    to: str,
    *,
    crs: str | None = None,
    out: Path | None = None,
    sites: Collection[str] = (),
    progress: ProgressCallback = no_progress,
) -> ExportResult:
    """Export a finished run.

    Parameters
    ----------
    folder
        The run's.
    to
        One of :data:`FORMATS`.
    crs
        One of :data:`egvs.export.finished_run.CRS_CHOICES`; the format's own by default, and local metres where it is
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
    its = _get_format(to, crs, sites)
    whole = is_city(folder)
    if whole and to == "geotiff":
        raise InputError("--to geotiff", f"{folder} is a city's run", f"a junction's: {folder / 'junctions' / 'NAME'}")
    run = open_any_run(folder) if whole else FinishedRun.open(folder)
    name = city_name(folder) if whole else run.scenario.name
    reference = _export_crs(run, its, crs)
    chosen = _selected_sites(run, sites)
    target = out or folder / EXPORT_FOLDER / (f"{safe_file_name(name)}{its.suffix}" if its.is_one_file else to)
    _check_target(target, its)
    _check_free([target] if its.is_one_file else [], out)
    with files.temporary_folder() as aside:
        if its.name == "geotiff":
            made, notes = list(_write_rasters(run, reference, aside, chosen, progress)), list[str]()
        else:
            layers, notes = city_layers(folder) if whole else run_layers(run)
            progress("layers made", 1, 2)
            made = list(_write_vectors(its, layers, reference, aside, target.name, name))
            progress("files written", 2, 2)
        paths = [target if its.is_one_file else target / path.name for path in made]
        _check_free(paths, out)
        _move_all(made, paths)
    if out is None and not its.is_one_file:
        _remove_stale_layers(target, paths)
    return ExportResult(tuple(paths), reference.words, tuple(notes))


def _get_format(to: str, crs: str | None, sites: Collection[str]) -> Format:
    if to not in FORMATS:
        raise InputError("--to", repr(to), f"one of {', '.join(FORMATS)}")
    if crs is not None and crs not in CRS_CHOICES:
        raise InputError("--crs", repr(crs), f"{SCENARIO_CRS} (its reference system) or {WGS84_CRS} (degrees)")
    if to == "kml" and crs == SCENARIO_CRS:
        raise InputError("--crs", f"{SCENARIO_CRS} with --to kml", f"{WGS84_CRS}: KML knows degrees only")
    if sites and to != "geotiff":
        raise InputError("--site", f"with --to {to}", "--to geotiff: the other formats hold all sites")
    plugins.require_libraries(f"export to {to}", "gis", *FORMATS[to].libraries)
    return FORMATS[to]


def _export_crs(run: FinishedRun, file_format: Format, crs: str | None) -> ExportCrs:
    choice = crs or file_format.crs
    if crs is None and run.frame is None and file_format.name != "kml":
        choice = SCENARIO_CRS
    x, y, _ = run.scenario.roi.center_m
    return ExportCrs.of(run.frame, choice, (x, y), f"{run.work.folder}: --to {file_format.name}")


def _selected_sites(run: FinishedRun, sites: Collection[str]) -> Collection[str]:
    """The sites whose views are written; InputError for one that the run has not."""
    known = parquet.read_artefact(run.artefact(RunFolder.scores.name), "scores")[0].column("site").to_pylist()
    for name in sites:
        if name not in known:
            some = ", ".join(known[:10]) + (", ..." if len(known) > 10 else "")
            raise InputError("--site", f"{name!r} is no site of this run", f"one of {some}")
    return tuple(dict.fromkeys(sites)) or (best_site(run),)


def _check_target(target: Path, file_format: Format) -> None:
    """InputError where files could not be written, or would replace one that is no export."""
    if file_format.is_one_file:
        if target.suffix != file_format.suffix:
            raise InputError(
                "--out", repr(str(target)), f"a file that ends in {file_format.suffix} for --to {file_format.name}"
            )
        files.check_writable(target)
        return
    if target.exists() and not target.is_dir():
        raise InputError("--out", f"{target} is a file", f"a folder: --to {file_format.name} writes several files")
    files.check_writable(target / f"any{file_format.suffix}")


def _check_free(paths: Sequence[Path], out: Path | None) -> None:
    """InputError where a file that the user names, or in a folder that the user names, would be replaced: a scenario
    has a ``sites.csv`` too, and a GeoPackage may hold other layers."""
    if out is not None and (there := [path for path in paths if path.exists()]):
        right = "another name" if there[0] == out else "a new folder, or one without such files"
        raise InputError("--out", f"{there[0]} is there already", right)


def _move_all(made: Sequence[Path], paths: Sequence[Path]) -> None:
    """All files to where they belong, or none."""
    for path in paths:
        files.ensure_writable_folder(path)
    with ExitStack() as partials:
        for path, done in zip(paths, made, strict=True):
            shutil.copyfile(done, partials.enter_context(files.atomic_write(path)))


def _remove_stale_layers(folder: Path, paths: Sequence[Path]) -> None:
    """Remove the layers that an earlier export left in a run's folder and that are no more: a plan of other sites."""
    for layer in NAMES:
        path = folder / f"{layer}{paths[0].suffix}"
        if path not in paths:
            path.unlink(missing_ok=True)


def _write_vectors(
    file_format: Format, layers: Sequence[Layer], reference: ExportCrs, temp_path: Path, name: str, title: str
) -> Iterator[Path]:
    from egvs.export import vector_files

    each: dict[str, Callable[[Path, Layer, ExportCrs], None]] = {
        "geojson": vector_files.write_geojson, "geoparquet": vector_files.write_geoparquet,
        "csv": vector_files.write_csv,
    }  # fmt: skip
    if file_format.name == "gpkg":
        vector_files.write_geopackage(temp_path / name, layers, reference)
        yield temp_path / name
    elif file_format.name == "kml":
        vector_files.write_kml(temp_path / name, title, layers, reference)
        yield temp_path / name
    else:
        for layer in layers:
            each[file_format.name](path := temp_path / f"{layer.name}{file_format.suffix}", layer, reference)
            yield path


def _write_rasters(
    run: FinishedRun, reference: ExportCrs, temp_path: Path, sites: Collection[str], progress: ProgressCallback
) -> Iterator[Path]:
    from egvs.export import rasters
    from egvs.export.rasters import run_rasters

    taken: set[str] = set()
    for number, raster in enumerate(run_rasters(run, sites), start=1):
        name = safe_file_name(raster.name)
        while taken & (its := {name.lower(), f"{name.lower()}_colours"}):  # of sites whose names differ in signs alone
            name += "_"
        taken |= its
        yield from rasters.write_geotiff(temp_path, raster, reference, name)
        progress(f"{raster.name} written", number, 1 + 3 * len(sites))


def safe_file_name(name: str) -> str:
    """A name that every disk takes."""
    return re.sub(r'[\s\x00-\x1f\x7f/\\:*?"<>|.]+', "_", name)[:80] or "_"


def unknown_site(name: str, known: Sequence[str]) -> InputError:
    """Return an error for a site that a run does not have."""
    listed = ", ".join(known[:10]) + (", ..." if len(known) > 10 else "")
    return InputError("--site", f"this run has no site {name!r}", f"Choose one of {listed}")
