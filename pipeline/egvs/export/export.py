"""Exports a run, or a folder of several, as vector layers: GeoPackage, GeoJSON, GeoParquet, KML or CSV.

Of a run also rasters as GeoTIFF, a site plan as DXF, and a 3D scene as glTF or USD.

Steps: check the request; open the run and choose the reference system; make the layers or rasters; write the files to a
temporary folder, and move them to their names when all are complete.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core import files, plugins
from egvs.core.errors import InputError, unknown_site
from egvs.core.progress import ProgressCallback, no_progress
from egvs.export import drawing, scene_files
from egvs.export.finished_run import CRS_CHOICES, SCENARIO_CRS, WGS84_CRS, ExportCrs, FinishedRun
from egvs.export.folder_kinds import find_kind
from egvs.export.layers import (
    NAMES,
    Layer,
    best_site,
    kml_layers,
    run_layers,
)
from egvs.results.map_credits import read_map_credits

EXPORT_FOLDER = "export"
"""The default folder for exports, in the run folder."""


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes
    ----------
    name, suffix
        Name on the command line, and suffix of the files.
    is_one_file
        Whether one file has all layers.
    crs
        Default reference system, one of :data:`egvs.export.finished_run.CRS_CHOICES`.
    libraries
        Optional libraries that write the format.
    extra
        The extra that installs them.
    needs_run
        Whether it shows what only a run has, so that other folders with layers cannot be exported.
    """

    name: str
    suffix: str
    is_one_file: bool
    crs: str
    libraries: tuple[str, ...] = ()
    extra: str = "gis"
    needs_run: bool = False


_FORMATS = (
    Format("gpkg", ".gpkg", True, SCENARIO_CRS, ("pyogrio",)),
    Format("geojson", ".geojson", False, WGS84_CRS),
    Format("geoparquet", ".parquet", False, SCENARIO_CRS, ("geopandas",)),
    Format("kml", ".kml", True, WGS84_CRS),
    Format("csv", ".csv", False, SCENARIO_CRS),
    Format("geotiff", ".tif", False, SCENARIO_CRS, ("rasterio",), needs_run=True),
    Format("dxf", ".dxf", True, SCENARIO_CRS, ("ezdxf",), needs_run=True),
    Format("glb", ".glb", False, SCENARIO_CRS, needs_run=True),
    Format("usd", ".usdc", False, SCENARIO_CRS, ("pxr",), extra="usd", needs_run=True),
)
_METRES = ("dxf", "glb", "usd")
"""Formats without degrees."""
FORMATS = {file_format.name: file_format for file_format in _FORMATS}


@dataclass(frozen=True)
class ExportResult:
    """The files, a description of their reference system, and notes on layers that were left out."""

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
    """Export a finished run, or a folder of several (:mod:`egvs.export.folder_kinds`).

    Parameters
    ----------
    folder
        The folder.
    to
        One of :data:`FORMATS`.
    crs
        One of :data:`egvs.export.finished_run.CRS_CHOICES`; by default that of the format, or local metres if the
        format would use degrees and the scenario has no reference system.
    out
        A file, or a folder for formats with several files; ``export`` in the run folder by default.
    sites
        Sites whose views are written as rasters; the best one by default.
    progress
        Called after each step.

    Returns
    -------
    ExportResult
        What was written.

    Raises
    ------
    InputError
        If an option is unknown, an artefact is missing or damaged, or a file cannot be written. Nothing is written
        then.
    MissingExtraError
        If the libraries are not installed.
    """
    file_format = _check_request(to, crs, sites)
    kind = find_kind(folder)
    if kind is None:
        run = FinishedRun.open(folder)
        title = run.scenario.name
    elif file_format.needs_run:
        raise InputError(f"--to {to}", f"{folder} is the folder of a {kind.name}", kind.part_hint(folder))
    else:
        run = kind.reference_run(folder)
        title = kind.title(folder)
    reference = _export_crs(run, file_format, crs)
    selected = _selected_sites(run, sites)
    target = out or _default_target(folder, file_format, title)
    _check_target(target, file_format)
    if file_format.is_one_file:
        _check_not_existing([target], out)

    credits = read_map_credits(run.scenario)
    notes: list[str] = []
    with files.temporary_folder() as temp_folder:
        if file_format.name == "geotiff":
            written = list(_write_rasters(run, reference, temp_folder, selected, progress))
            if run.work.inputs.common_network is None:
                notes.append("points on target are left out: the traffic does not come from one road network")
            if run.has_outdated_plan:
                notes.append("the plan's overlap is left out: it is for other traffic. Run egvs place again")
        elif file_format.name in ("glb", "usd"):
            written = list(scene_files.write_scene(temp_folder, run, reference, is_usd=to == "usd"))
            progress("files written", 1, 1)
        else:
            layers, notes = run_layers(run) if kind is None else kind.layers(folder)
            if file_format.name == "kml" and kind is None:
                layers = kml_layers(run, layers, notes)
            progress("layers made", 1, 2)
            if file_format.name == "dxf":
                notes += drawing.write_dxf(temp_folder / target.name, run, layers, reference)
                written = [temp_folder / target.name]
            else:
                written = list(_write_vectors(file_format, layers, reference, temp_folder, target.name, title, credits))
            progress("files written", 2, 2)
        paths = [target]
        if not file_format.is_one_file:
            paths = [target / path.name for path in written]
        _check_not_existing(paths, out)
        _move_all(written, paths)
    if out is None and not file_format.is_one_file:
        _remove_stale_layers(target, paths)
    if credits:
        notes.append(f"name the makers of the map where you show it: {'; '.join(credits)}")
    return ExportResult(tuple(paths), reference.description, tuple(notes))


def _check_request(to: str, crs: str | None, sites: Collection[str]) -> Format:
    if to not in FORMATS:
        raise InputError("--to", f"expected one of {', '.join(FORMATS)}, got {to!r}")
    if crs is not None and crs not in CRS_CHOICES:
        hint = f"Use {SCENARIO_CRS} for the scenario's reference system, {WGS84_CRS} for degrees."
        raise InputError("--crs", f"expected {' or '.join(CRS_CHOICES)}, got {crs!r}", hint)
    if to in _METRES and crs == WGS84_CRS:
        problem = f"{to} files are always in metres"
        raise InputError("--crs", problem, f"Use --crs {SCENARIO_CRS}, or omit --crs.")
    if to == "kml" and crs == SCENARIO_CRS:
        raise InputError("--crs", "KML files are always in degrees", f"Use --crs {WGS84_CRS}, or omit --crs.")
    if sites and to != "geotiff":
        hint = "Omit --site: the other formats contain all sites."
        raise InputError("--site", f"works only with --to geotiff, got --to {to}", hint)
    plugins.require_libraries(f"export to {to}", FORMATS[to].extra, *FORMATS[to].libraries)
    return FORMATS[to]


def _export_crs(run: FinishedRun, file_format: Format, crs: str | None) -> ExportCrs:
    choice = crs or file_format.crs
    if crs is None and run.frame is None and file_format.name != "kml":
        choice = SCENARIO_CRS
    x, y, _ = run.scenario.roi.center_m
    return ExportCrs.from_choice(run.frame, choice, (x, y), f"{run.work.folder}: --to {file_format.name}")


def _selected_sites(run: FinishedRun, sites: Collection[str]) -> Collection[str]:
    """The sites whose views are written; InputError for an unknown one."""
    known = parquet.read_artefact(run.artefact(RunFolder.scores.name), "scores")[0].column("site").to_pylist()
    for name in sites:
        if name not in known:
            raise unknown_site("--site", name, known, "this run has")
    return tuple(dict.fromkeys(sites)) or (best_site(run),)


def _default_target(folder: Path, file_format: Format, title: str) -> Path:
    if file_format.is_one_file:
        return folder / EXPORT_FOLDER / f"{safe_file_name(title)}{file_format.suffix}"
    return folder / EXPORT_FOLDER / file_format.name


def _check_target(target: Path, file_format: Format) -> None:
    """InputError if the files cannot be written, or the target is a file of the wrong kind."""
    option = f"--to {file_format.name}"
    if file_format.is_one_file:
        if target.suffix != file_format.suffix:
            problem = f"expected a file name ending in {file_format.suffix} for {option}, got {str(target)!r}"
            raise InputError("--out", problem, "Change the file name, or --to.")
        files.check_writable(target)
        return
    if target.exists() and not target.is_dir():
        raise InputError("--out", f"{target} is a file", f"Give a folder: {option} writes several files.")
    files.check_writable(target / f"any{file_format.suffix}")


def _check_not_existing(paths: Sequence[Path], out: Path | None) -> None:
    """InputError if a file would be replaced that the user may have made: a scenario has a ``sites.csv`` too."""
    if out is None:
        return
    for path in paths:
        if path.exists():
            hint = "Choose a new folder, or one without these files."
            if path == out:
                hint = "Choose another name."
            raise InputError("--out", f"{path} already exists", hint)


def _move_all(sources: Sequence[Path], targets: Sequence[Path]) -> None:
    """Move all files, or none."""
    for target in targets:
        files.ensure_writable_folder(target)
    with ExitStack() as partials:
        for source, target in zip(sources, targets, strict=True):
            shutil.copyfile(source, partials.enter_context(files.atomic_write(target)))


def _remove_stale_layers(folder: Path, paths: Sequence[Path]) -> None:
    """Remove layers of an earlier export that the run no longer has, such as an outdated plan."""
    for layer in NAMES:
        path = folder / f"{layer}{paths[0].suffix}"
        if path not in paths:
            path.unlink(missing_ok=True)


def _write_vectors(
    file_format: Format,
    layers: Sequence[Layer],
    reference: ExportCrs,
    folder: Path,
    name: str,
    title: str,
    credits: Sequence[str],
) -> Iterator[Path]:
    from egvs.export import vector_files

    if file_format.name == "gpkg":
        vector_files.write_geopackage(folder / name, layers, reference)
        yield folder / name
        return
    if file_format.name == "kml":
        vector_files.write_kml(folder / name, title, layers, reference, credits)
        yield folder / name
        return
    writers: dict[str, Callable[[Path, Layer, ExportCrs], None]] = {
        "geojson": partial(vector_files.write_geojson, credits=credits),
        "geoparquet": vector_files.write_geoparquet,
        "csv": vector_files.write_csv,
    }
    for layer in layers:
        path = folder / f"{layer.name}{file_format.suffix}"
        writers[file_format.name](path, layer, reference)
        yield path


def _write_rasters(
    run: FinishedRun, reference: ExportCrs, folder: Path, sites: Collection[str], progress: ProgressCallback
) -> Iterator[Path]:
    from egvs.export import rasters

    used: set[str] = set()
    for number, raster in enumerate(rasters.run_rasters(run, sites), start=1):
        name = safe_file_name(raster.name)
        while not used.isdisjoint(_raster_file_stems(name)):  # names that differ only in replaced characters
            name += "_"
        used |= _raster_file_stems(name)
        yield from rasters.write_geotiff(folder, raster, reference, name)
        progress(f"{raster.name} written", number, 0)


def _raster_file_stems(name: str) -> set[str]:
    return {name.lower(), f"{name.lower()}_colours"}


def safe_file_name(name: str) -> str:
    """Return a file name that is valid on every file system."""
    return re.sub(r'[\s\x00-\x1f\x7f/\\:*?"<>|.]+', "_", name)[:80] or "_"
